"""Trainings of trials, and their metrics over seeds."""

from types import SimpleNamespace

import pytest

from armscan.config.compose import compose_run
from armscan.config.defaults import to_plain
from armscan.errors import CheckpointError
from armscan.sweeps.tasks import training
from armscan.sweeps.tasks.attempt import over_seeds
from armscan.sweeps.tasks.training import _train
from armscan.tracking import open_store
from tests.support import FEW_VOLUMES


@pytest.mark.parametrize("interval", [None, (0, 400)], ids=["whole", "generation"])
def test_seed_of_an_earlier_attempt_is_trained_again_for_the_next_generation(tmp_path, monkeypatch, interval):
    trained, adopted = [], []
    monkeypatch.setattr(training, "_train", lambda attempt, seed, conclude: trained.append(seed) or {"mean_steps": 1.0})
    monkeypatch.setattr(training, "adopt", lambda attempt, seed: adopted.append(seed))
    attempt = SimpleNamespace(seeds=(0, 1), seeds_done={0: {"mean_steps": 2.0}}, folder=tmp_path, interval=interval)
    attempt.keep_seed = attempt.seeds_done.__setitem__
    training.TrainingTask().run(attempt)
    assert (trained, adopted) == (([1], [0]) if interval is None else ([0, 1], []))


@pytest.mark.usefixtures("database")
def test_run_of_a_generation_whose_parent_left_nothing_fails_with_that_reason(tmp_path):
    config, choices = compose_run([*("sweep=sac_y", *FEW_VOLUMES), f"tracking.artifacts={tmp_path}/artifacts"])
    client, experiment_id = open_store(**to_plain(config.tracking))
    opened = []
    attempt = SimpleNamespace(
        run_id=client.create_run(experiment_id, name="trial", tags={"study": "a"}).info.run_id,
        tags={"study": "a"},
        trial=SimpleNamespace(number=1),
        folder=tmp_path / "0001",
        folders_before=(),
        parent_folder=tmp_path / "0000",
        interval=(400, 800),
        overrides=[],
        command="",
        study_folder=tmp_path,
        config=lambda _: (config, choices),
        opened=opened.append,
        objectives=(),
        seeds_done={},
    )
    with pytest.raises(CheckpointError, match="the next generation needs"):
        _train(attempt, 0, None)
    run = client.get_run(opened[0].run_id)
    assert run.info.status == "FAILED"
    assert "the next generation needs" in run.data.tags["failure"]


def test_trial_reports_and_returns_the_same_figure_over_its_seeds():
    assert over_seeds("mean_steps", [1.0, 1.0, 25.0, 1.0]) == 1.0
    assert over_seeds("mean_steps", [1.0, 4.0]) == 2.5
    assert over_seeds("solved", [0.0, 1.0, 1.0, 1.0]) == 0.75
