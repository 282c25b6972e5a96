"""The order of a run's end: figures before the film and the export of the policy, which take time."""

import pytest

from armscan.config.compose import compose_run
from armscan.experiment import runner
from armscan.experiment.job import Invocation
from armscan.policies import build
from tests.test_run import SMALL


@pytest.mark.full
def test_figures_are_shown_before_the_video_and_the_export(tmp_path, monkeypatch, capsys):
    printed_before = []

    def noted(*_arguments, **_options):
        printed_before.append(capsys.readouterr().out)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runner, "record_episode", noted)
    monkeypatch.setattr(build, "save_policy", noted)
    config, choices = compose_run(SMALL)
    invocation = Invocation(tmp_path / "run", SMALL, "armscan run", choices)
    invocation.folder.mkdir()
    runner.run_experiment(config, invocation)
    before_film, before_export = printed_before
    assert "results (deterministic policy" in before_film
    assert "on plane" in before_film
    assert "results" not in before_export
