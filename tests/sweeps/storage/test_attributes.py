"""A study in a storage that a stranger has written: refused in one line, or usable."""

import json
import sqlite3

import optuna
import pytest
from optuna.trial import TrialState, create_trial

from armscan.errors import ArmscanError
from armscan.sweeps.results.report import write_report
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.retry import fail_and_retry
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.storage import attribute_names as names
from armscan.sweeps.storage.attribute_names import (
    FINAL_SEED,
    FINALIST,
    FIXED,
    LEASE,
    METRICS,
    OBJECTIVES,
)
from armscan.sweeps.storage.attributes import StudyAttributes, TrialAttributes, check_trials
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.study import make_study
from armscan.sweeps.workers.heartbeat import LivenessCheck
from tests.support.refusals import assert_refused
from tests.sweeps.study.test_study import settings

OF_TRIAL = [*TrialAttributes.model_fields]
OF_LEASE = ["worker", "host", "pid", "started", "directory", "boot", "pid_namespace", "code", "beat", "seed", "return"]
# Attributes of a study in which some of the odd values are harmless.
HARMLESS_OF_STUDY = {
    *(names.STUDY_RUN, names.NOTE_SUM, names.BEGUN_WITH, names.BEGUN_IN),
    *(names.EARLIER_CONFIGS, names.TERMINATED, names.RESET_FAILURES, names.STOP),
}
ODD = [None, True, -1, 1.5, 10**400, "x", "\0", "\x1b[31m", [], ["x"], {}, {"a": 1}, {"a": None}, {"0": {"a": {}}}]


def is_refused(check):
    """Return whether a check raises; its message must be one short line."""
    line = ""
    try:
        check()
    except ArmscanError as error:
        line = str(error)
    assert not {"\n", "\x1b"} & set(line)
    assert len(line) < 1000
    return line != ""


def study_with(trial_attributes, state=TrialState.RUNNING):
    storage = optuna.storages.InMemoryStorage()
    study = optuna.create_study(study_name="a", storage=storage)
    study.set_user_attr(OBJECTIVES, {"mean_steps": "minimize"})
    study.add_trial(create_trial(state=state, value=None, user_attrs=trial_attributes))
    return study


def work_with(study, folder):
    """Do what workers, the monitor and the report do with trials of others; return the report."""
    scheduler = TrialScheduler(study, None, Limits(n_trials=1, max_failures=0, max_retries=0))
    state = scheduler.state()
    assert state.env_steps >= 0
    scheduler.end_reason(state)
    for trial in state.running:
        LivenessCheck().is_dead(trial)
        fail_and_retry(study, trial, state, max_retries=0)
    return write_report(study, [], folder)


def test_every_attribute_is_checked():
    ours = {value for name, value in vars(names).items() if name.isupper() and isinstance(value, str)}
    assert {*OF_TRIAL, *StudyAttributes.model_fields} == ours - {names.EPISODES, names.SUBJECTS, names.CODE}
    assert set(StudyAttributes.model_fields) == {names.SPACE, names.FIXED, names.OBJECTIVES, *HARMLESS_OF_STUDY}


@pytest.mark.parametrize("value", ODD, ids=lambda value: repr(value)[:10])
def test_attribute_of_a_trial_of_any_type_is_refused_in_one_line_or_harmless(tmp_path, value):
    for state in (TrialState.RUNNING, TrialState.FAIL):
        for attributes in (*({name: value} for name in OF_TRIAL), *({LEASE: {name: value}} for name in OF_LEASE)):
            study = study_with(attributes, state=state)
            assert is_refused(lambda study=study: check_trials(study)) or work_with(study, tmp_path).is_file()


@pytest.mark.parametrize("value", ODD, ids=lambda value: repr(value)[:10])
def test_attribute_that_a_stranger_writes_while_a_study_runs_is_one_line_or_harmless(tmp_path, value):
    for number, name in enumerate([*OF_TRIAL, *OF_LEASE]):
        uri = str(tmp_path / f"{number}.journal")
        study = make_study(open_storage(uri), settings(storage=uri), {})
        trial = study.ask()
        stranger = optuna.load_study(study_name="a", storage=open_storage(uri).optuna)
        damage = {name: value} if name in OF_TRIAL else {LEASE: {name: value}}
        for key, damaged in damage.items():
            stranger._storage.set_trial_user_attr(trial._trial_id, key, damaged)
        was_refused = is_refused(lambda study=study: work_with(study, tmp_path))
        # The same as when a study is opened.
        sound = study_with(damage)
        assert was_refused == is_refused(lambda sound=sound: check_trials(sound))
        if was_refused:
            assert is_refused(lambda study=study, trial=trial: study._storage.get_trial(trial._trial_id))


def test_final_training_of_nothing_that_a_stranger_adds_while_a_study_runs_is_refused(tmp_path):
    study = optuna.create_study(study_name="a-judged", storage=open_storage(str(tmp_path / "a.journal")).optuna)
    study.add_trial(create_trial(value=1.0, user_attrs={FINALIST: 0}))
    assert is_refused(lambda: study.get_trials(deepcopy=False))


@pytest.mark.parametrize("name", StudyAttributes.model_fields)
def test_attribute_of_a_study_of_any_type_is_refused_in_one_line_or_harmless(tmp_path, name):
    for number, value in enumerate(ODD):
        storage = open_storage(str(tmp_path / f"{number}.journal"))
        study = make_study(storage, settings(), {})
        study.set_user_attr(name, value)
        # At most one of them is what it was.
        was_refused = is_refused(lambda storage=storage: make_study(storage, settings(), {}))
        assert was_refused or name in HARMLESS_OF_STUDY or (name, value) == (FIXED, {})


@pytest.mark.parametrize(
    ("attributes", "line"),
    [
        ({FINAL_SEED: 3}, r"a.trials\[0\].user_attrs lacks judged, which each final training has"),
        ({FINALIST: 0}, "lacks judged_seed"),
        ({FINALIST: 0, FINAL_SEED: 3}, "lacks figures"),
        (
            {FINALIST: -2, FINAL_SEED: 3, METRICS: {}},
            "judged is -2, but it must be a whole number of at least 0, or -1",
        ),
        (
            {FINALIST: 7, FINAL_SEED: 3, METRICS: {}},
            "judged is 7, but it must be -1 for the control, or the number of one of 4",
        ),
    ],
)
def test_final_training_of_nothing_is_refused(attributes, line):
    study = optuna.create_study(study_name="a")
    study.add_trial(create_trial(value=1.0, user_attrs=attributes))
    with pytest.raises(ArmscanError, match=line):
        check_trials(study, n_searched=4)


STATEMENTS = {
    "no value": "DELETE FROM trial_values",
    "infinite value": "UPDATE trial_values SET value_type = 'INF_POS', value = NULL",
    "distribution": "UPDATE trial_params SET distribution_json = '{'",
    "unknown distribution": 'UPDATE trial_params SET distribution_json = \'{"name": "os.system", "attributes": {}}\'',
    "attribute": "UPDATE trial_user_attributes SET value_json = '{'",
    "state": "UPDATE trials SET state = 'FINISHED'",
    "time": "UPDATE trials SET datetime_start = 'yesterday'",
    "direction": "DELETE FROM study_directions",
    "text for a number": "UPDATE trial_values SET value = 'many'",
}


@pytest.mark.parametrize("statement", STATEMENTS.values(), ids=STATEMENTS)
def test_report_of_rows_that_optuna_has_not_written_is_one_line(armscan, tmp_path, statement):
    uri = f"sqlite:///{tmp_path}/a.db"
    study = make_study(open_storage(uri), settings(storage=uri), {})
    trial = study.ask()
    trial.suggest_float("agent.lr", 1e-4, 1e-2)
    trial.set_user_attr("env_steps", 3)
    study.tell(trial, 1.0)
    with sqlite3.connect(tmp_path / "a.db") as database:
        database.execute(statement)
    assert_refused(armscan("report", "--study", "a", "--storage", uri), "")


@pytest.mark.parametrize(
    "change",
    [
        {"distribution": "{"},
        {"distribution": json.dumps({"name": "CategoricalDistribution", "attributes": {"choices": []}})},
        {"param_value_internal": "x"},
        {"param_value_internal": 7},
        {"datetime_complete": 3},
        {"datetime_start": "yesterday"},
        {"state": 99},
        {"values": ["x"]},
        {"values": None},
        {"values": 3},
        {"values": [1.0, 2.0]},
        {"step": "x"},
        {"intermediate_value": "x"},
        {"user_attr": 3},
        {"trial_id": "x"},
        {"study_id": "x"},
        {"op_code": 99},
        {"op_code": "x"},
    ],
    ids=str,
)
def test_report_of_journal_lines_that_optuna_has_not_written_is_one_line(armscan, tmp_path, change):
    journal = tmp_path / "a.journal"
    study = make_study(open_storage(str(journal)), settings(), {})
    trial = study.ask()
    trial.suggest_categorical("obs", ["plane", "image"])
    trial.set_user_attr("env_steps", 3)
    trial.report(0.5, 1)
    study.tell(trial, 1.0)
    # As a stranger would write it: consistent, without checksums.
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    for line in lines:
        del line["sum"]
        line.update({key: value for key, value in change.items() if key in line})
    journal.write_text("".join(json.dumps(line, separators=(",", ":")) + "\n" for line in lines))
    assert_refused(armscan("report", "--study", "a", "--storage", str(journal)), "")
