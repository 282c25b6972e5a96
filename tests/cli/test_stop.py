"""`armscan runs stop` on studies, trials, and what is neither."""

from functools import partial

import optuna
import pytest

from armscan.sweeps.storage.storage import open_storage
from tests.support.stores import store_in


@pytest.fixture
def answer(armscan):
    """Run the command in an empty folder; return its exit code and what it printed."""
    return partial(armscan, "runs", "stop")


@pytest.fixture
def study(tmp_path):
    """Return a study with a running trial, and one that has ended."""
    study = optuna.create_study(study_name="a", storage=open_storage(str(tmp_path / "optuna.journal")).optuna)
    for name in ("objectives", "space", "fixed_config"):
        study.set_user_attr(name, {"x": "minimize"} if name == "objectives" else {})
    study.ask()
    study.tell(study.ask(), 1.0)
    return study


@pytest.fixture
def run_with(tmp_path):
    """Make a run with tags; return its ID."""

    def make(status=None, **tags):
        client, experiment_id = store_in(tmp_path, "a")
        run_id = client.create_run(experiment_id, name="any", tags=tags).info.run_id
        if status:
            client.set_terminated(run_id, status)
        return run_id

    return make


def stops_of(study):
    return [trial.user_attrs.get("stop", "") for trial in study.get_trials()], study.user_attrs.get("stop", "")


def test_study_is_stopped_by_its_name_and_by_its_run(answer, study, run_with):
    requeued = "study a: 1 running trial will be requeued within ten seconds and an epoch"
    line = f"{requeued}; the command that started it resumes it\n"
    assert answer("a") == (0, line, "")
    assert stops_of(study)[1]
    study.set_user_attr("stop", "")
    assert answer(run_with(study="a")[:12]) == (0, line, "")
    assert stops_of(study)[1]


def test_stopped_study_without_a_running_trial_says_so(answer, study):
    study.tell(0, 1.0)
    line = "study a: no trial is running; the command that started it resumes it, unless it has ended\n"
    assert answer("a") == (0, line, "")


def test_trial_is_stopped_by_its_run(answer, study, run_with):
    printed = "trial 0 of study a will end within ten seconds and an epoch, as pruned; it counts as finished\n"
    assert answer(run_with(study="a", trial="0")) == (0, printed, "")
    (of_trial, of_other), of_study = stops_of(study)
    assert of_trial
    assert (of_other, of_study) == ("", "")


@pytest.mark.parametrize(
    ("tags", "line"),
    [
        ({"study": "a", "trial": "1"}, "trial 1 of study a has ended already (complete)"),
        ({"study": "a", "trial": "7"}, "the trial is 7, but study a has 2 trials"),
        ({"study": "b", "trial": "0"}, "the study is 'b', but it is not in 'optuna.journal': give --storage URI"),
        ({"study": "b"}, "the study is 'b', but it is not in 'optuna.journal': give --storage URI"),
        ({"study": "a", "trial": "-1"}, "run {}: its tag trial is '-1', but it must be a number"),
        ({}, "run {} belongs to no study, and this machine knows no process of it"),
    ],
    ids=str,
)
def test_what_cannot_be_stopped_is_said_in_one_line(answer, study, run_with, tags, line):
    run_id = run_with(**tags)
    assert answer(run_id) == (2, "", f"error: {line.format(run_id)}")
    assert stops_of(study) == (["", ""], "")


def test_study_of_the_same_name_in_another_storage_is_not_stopped(answer, study, run_with):
    study.set_user_attr("mlflow_run", "0" * 32)
    study._storage.set_trial_user_attr(study.get_trials()[0]._trial_id, "mlflow_run", "1" * 32)
    tags = {"study": "a", "study.storage": "postgresql://me@elsewhere/db"}
    line = "error: the study a in 'optuna.journal' is not the one of this run, which is in postgresql://me@elsewhere/db"
    for more in ({}, {"trial": "0"}):
        assert answer(run_with(**tags, **more)) == (2, "", f"{line}: give that with --storage")
    assert stops_of(study) == (["", ""], "")
    # The run of one of the trial's seeds.
    assert answer(run_with(**tags, trial="0", **{"mlflow.parentRunId": "1" * 32}))[0] == 0
    assert stops_of(study)[0][0]


def test_run_that_has_ended_is_not_interrupted(answer, run_with):
    run_id = run_with(status="FINISHED")
    assert answer(run_id) == (2, "", f"error: run {run_id} has ended already (FINISHED)")


def test_what_is_neither_run_nor_study_is_refused_as_both(answer, study, run_with):
    run_with()
    # No ID of a run begins like these.
    for unknown in ("x", "nobody"):
        code, _, said = answer(unknown)
        assert code == 2
        assert f"'{unknown}'" in said
        assert said.endswith(f"; and optuna.journal has no study '{unknown}'")


def test_nothing_is_made_where_there_is_no_study(answer, run_with, tmp_path):
    assert answer(run_with(study="a"))[0] == 2
    assert not (tmp_path / "optuna.journal").exists()
