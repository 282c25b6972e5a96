"""The progress bar of a training."""

import pytest
from rich.console import Console

from armscan.training import EpochReport, Evaluation
from armscan.training.progress import ProgressBar
from tests.training.test_train import episode_of


@pytest.fixture
def narrow(monkeypatch):
    """Return a terminal of 80 columns, which keeps what is printed."""
    console = Console(width=80, force_terminal=True, record=True)
    monkeypatch.setattr("rich._console", console)
    return console


def test_progress_bar_shows_all_of_its_figures_in_80_columns(narrow):
    evaluation = Evaluation((episode_of(50, episode_return=-123.456),))
    report = EpochReport(epoch=1, n_env_steps=120_000, wall_s=60.0, metrics={}, evaluation=evaluation, is_best=True)
    bar = ProgressBar("validation, 48 episodes, deterministic")
    bar.on_start(240_000, [report])
    bar.on_end()
    heading, line = narrow.export_text().strip().splitlines()
    assert heading == "training; figures: validation, 48 episodes, deterministic"
    for figure in ("120000/240000", "on plane, 5 mm 10° 100%", "success 100%", "steps 50.00", "-:--:--"):
        assert figure in line
    assert "━" in line
    # Drawn at the start and at the end, with room for the echo of a Ctrl-C.
    assert len(line) == 2 * (80 - len("^C"))
