"""Trainings of trials that an earlier attempt has begun: which are resumed, and where."""

import json
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from armscan.config.compose import compose_run
from armscan.config.defaults import to_plain
from armscan.experiment.build import set_up
from armscan.sweeps.tasks.resume import _begun_in, adopt, start_or_resume
from armscan.tracking import open_store
from tests.support import FEW_VOLUMES


@pytest.mark.parametrize(
    ("study_run", "trial_run", "is_ours"),
    [("this", "this", True), ("this", "an earlier attempt's", True), ("another", "another", False)],
    ids=["requeued", "retried", "of a deleted study of this name"],
)
def test_training_is_resumed_if_this_study_has_begun_it(tmp_path, database, study_run, trial_run, is_ours):
    tracking = {"uri": database, "experiment": "a", "artifacts": str(tmp_path / "artifacts"), "wait_s": 60.0}
    client, experiment_id = open_store(**tracking)

    def made(name, **tags):
        return client.create_run(experiment_id, name=name, tags=tags).info.run_id

    studies = {name: made(name, study="a") for name in ("this", "another")}
    this = made("trial", **{"study": "a", "mlflow.parentRunId": studies["this"]})
    of_trial = this if trial_run == "this" else made(trial_run, **{"mlflow.parentRunId": studies[study_run]})
    training = made("training", **{"study": "a", "seed": "0", "mlflow.parentRunId": of_trial})
    (tmp_path / "run.json").write_text(json.dumps({"run_id": training}))
    attempt = SimpleNamespace(run_id=this, tags={"study": "a"}, trial=SimpleNamespace(number=0))
    found = _begun_in(tmp_path, attempt, OmegaConf.create({"tracking": tracking, "seed": 0}))
    assert (found is not None and found[1].info.run_id == training) is is_ours


def test_finished_seed_of_an_earlier_attempt_is_moved_below_its_retry(tmp_path, database):
    tracking = {"uri": database, "experiment": "a", "artifacts": str(tmp_path / "artifacts"), "wait_s": 60.0}
    client, experiment_id = open_store(**tracking)
    runs = {}
    for name, parent in (("study", ""), ("before", "study"), ("retry", "study"), ("seed", "before")):
        tags = {"study": "a", "seed": "0", "mlflow.parentRunId": runs.get(parent, "")}
        runs[name] = client.create_run(experiment_id, name=name, tags=tags).info.run_id
    before, folder = (tmp_path / each / "seed_0" for each in ("0000", "0004"))
    before.mkdir(parents=True)
    (before / "run.json").write_text(json.dumps({"run_id": runs["seed"]}))
    (before / "best.pt").write_bytes(b"weights")
    attempt = SimpleNamespace(
        run_id=runs["retry"],
        tags={"study": "a", "trial": "4"},
        trial=SimpleNamespace(number=4),
        folder=folder.parent,
        folders_before=[before.parent],
        config=lambda seed: (OmegaConf.create({"tracking": tracking, "seed": seed}), {}),
    )
    for _ in range(2):
        adopt(attempt, 0)
    tags = client.get_run(runs["seed"]).data.tags
    assert (tags["mlflow.parentRunId"], tags["trial"], tags["folder"]) == (runs["retry"], "4", str(folder))
    assert (folder / "best.pt").read_bytes() == b"weights"
    assert json.loads((folder / "run.json").read_text()) == {"run_id": runs["seed"]}


@pytest.mark.usefixtures("database")
def test_training_that_was_interrupted_before_its_first_epoch_resumes_its_run(tmp_path):
    config, choices = compose_run([*("sweep=sac_y", *FEW_VOLUMES), f"tracking.artifacts={tmp_path}/artifacts"])
    setup = set_up(config)
    client, experiment_id = open_store(**to_plain(config.tracking))
    study = client.create_run(experiment_id, name="study", tags={"study": "a"}).info.run_id
    tags = {"study": "a", "mlflow.parentRunId": study}
    of_trial = client.create_run(experiment_id, name="trial", tags=tags).info.run_id
    attempt = SimpleNamespace(
        run_id=of_trial,
        tags={"study": "a"},
        trial=SimpleNamespace(number=0),
        folders_before=(),
        overrides=[],
        command="",
        study_folder=tmp_path,
        parent_folder=None,
    )
    ids = []
    for _ in range(2):
        _, tracked, earlier = start_or_resume(attempt, setup, config, choices, tmp_path)
        assert earlier is None
        tracked.end_requeued()
        ids.append(tracked.run_id)
    assert ids[0] == ids[1]
    # A training whose checkpoint is gone would track its epochs twice.
    client.log_metric(ids[0], "validation/mean_steps", 1.0)
    _, tracked, _ = start_or_resume(attempt, setup, config, choices, tmp_path)
    tracked.end_requeued()
    assert tracked.run_id != ids[0]
