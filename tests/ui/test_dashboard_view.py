"""The view of armscan's trials in Optuna's dashboard."""

import json
import urllib.error
import urllib.request

import optuna
import pytest

from armscan.sweeps.storage.attribute_names import FINALIST
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.dashboard import LOCAL_UI, note_run, table_of_seeds
from armscan.ui.servers import start_dashboard
from tests.support.ports import free_port

MLFLOW = "http://127.0.0.1:5123"
LEASE = {"worker": "here-1", "pid": 12, "started": "x", "beat": 3, "seed": 1, "env_steps": 700, "return": -8.123456}
KEPT = {
    "lease": LEASE,
    "env_steps": 900,
    "figures": {"mean_steps": 3.0},
    "seeds": {"0": {"mean_steps": 3.0}},
    "config_sha256": "0" * 64,
    "study_config_sha256": "0" * 64,
    "mlflow_run": "1" * 32,
    "folder": "studies/a/trials/0000",
}


class Store:
    uri = "sqlite:///mlruns.db"


@pytest.fixture
def dashboard(tmp_path):
    """Return a function that makes a study with these attributes and returns it as the dashboard lists and shows it."""

    def made(of_study, of_trial, *, is_running=False):
        storage = open_storage(str(tmp_path / "optuna.journal"))
        # Other programs may write attributes of any type.
        storage.optuna.checks_reads = False
        study = optuna.create_study(study_name="a", storage=storage.optuna)
        for name, value in of_study.items():
            study.set_user_attr(name, value)
        trial = study.ask()
        for name, value in of_trial.items():
            trial.set_user_attr(name, value)
        note_run(trial, Store, "1", "1" * 32, tmp_path, table_of_seeds({0: {"mean_steps": 3.0}}))
        if not is_running:
            study.tell(trial, 1.0)
        address = start_dashboard(storage, tmp_path, free_port(), mlflow=MLFLOW)
        with urllib.request.urlopen(f"{address}/api/studies", timeout=30) as answer:
            (summary,) = json.loads(answer.read())["study_summaries"]
        with urllib.request.urlopen(f"{address}/api/studies/{study._study_id}", timeout=30) as answer:
            assert int(answer.headers["Content-Length"]) > 0
            return summary, json.loads(answer.read())

    return made


def shown(attributes):
    return {each["key"]: each["value"] for each in attributes}


def test_bookkeeping_of_workers_is_not_shown(dashboard):
    kept = {"space": {}, "fixed_config": {}, "objectives": {"mean_steps": "minimize"}, "mlflow_run": "1", "mine": 1}
    summary, study = dashboard(kept, KEPT | {"steps, mean": 3.0})
    (trial,) = study["trials"]
    assert shown(trial["user_attrs"]) == {"environment steps": "900", "steps, mean": "3.0"}
    assert shown(study["best_trials"][0]["user_attrs"]) == shown(trial["user_attrs"])
    assert [each["key"] for each in study["union_user_attrs"]] == ["environment steps", "steps, mean"]
    assert shown(study["user_attrs"]) == shown(summary["user_attrs"]) == {"mine": "1"}


def test_running_trial_says_how_far_it_is(dashboard):
    _, study = dashboard({}, {"lease": LEASE}, is_running=True)
    assert shown(study["trials"][0]["user_attrs"]) == {
        "worker": "here-1",
        "seed": "1",
        "environment steps": "700",
        "return, mean": "-8.123",
    }


def test_links_lead_to_the_port_at_which_mlflow_is(dashboard):
    _, study = dashboard({}, KEPT)
    note = study["trials"][0]["note"]["body"]
    assert f"({MLFLOW}/#/experiments/1/runs/{'1' * 32})" in note
    assert LOCAL_UI not in note
    assert "| steps, mean | 3.00 |" in note


def test_studies_of_others_are_shown_as_they_are(dashboard):
    _, study = dashboard({"space": "theirs"}, {"folder": "mine", "figures": [1]})
    assert shown(study["trials"][0]["user_attrs"]) == {"folder": "mine", "figures": "[1]"}
    assert shown(study["user_attrs"]) == {"space": "theirs"}


def fail_trial(storage, tmp_path, trial):
    """Press the button that fails a trial; return the trial afterwards."""
    address = start_dashboard(storage, tmp_path, free_port())
    told = urllib.request.Request(
        f"{address}/api/trials/{trial._trial_id}/tell",
        json.dumps({"state": "fail"}).encode(),
        {"Content-Type": "application/json"},
    )
    with urllib.request.urlopen(told, timeout=30) as answer:
        assert answer.status == 204
    return storage.optuna.get_trial(trial._trial_id)


def test_button_that_fails_a_trial_asks_its_worker_to_end_it(tmp_path):
    storage = open_storage(str(tmp_path / "optuna.journal"))
    trial = optuna.create_study(study_name="a", storage=storage.optuna).ask()
    trial.set_user_attr("lease", LEASE)
    asked = fail_trial(storage, tmp_path, trial)
    assert asked.state.name == "RUNNING"
    assert asked.user_attrs["stop"].startswith("at 20")


@pytest.mark.parametrize("attributes", [{"lease": LEASE}, {}], ids=["running", "waiting"])
def test_button_stops_no_training_of_the_final_evaluation(tmp_path, attributes):
    storage = open_storage(str(tmp_path / "optuna.journal"))
    trial = optuna.create_study(study_name="a-judged", storage=storage.optuna).ask()
    for name, value in (attributes | {FINALIST: 1}).items():
        trial.set_user_attr(name, value)
    with pytest.raises(urllib.error.HTTPError, match="409") as refused:
        fail_trial(storage, tmp_path, trial)
    assert "cannot be stopped alone" in json.loads(refused.value.read())["reason"]
    now = storage.optuna.get_trial(trial._trial_id)
    assert (now.state.name, "stop" in now.user_attrs) == ("RUNNING", False)


def test_button_fails_trials_of_others(tmp_path):
    storage = open_storage(str(tmp_path / "optuna.journal"))
    trial = optuna.create_study(study_name="theirs", storage=storage.optuna).ask()
    failed = fail_trial(storage, tmp_path, trial)
    assert (failed.state.name, failed.user_attrs) == ("FAIL", {})


@pytest.mark.parametrize("lease", ["{", "[1]", [1], 3])
def test_lease_that_is_none_hides_no_study(dashboard, lease):
    _, study = dashboard({}, {"lease": lease, "env_steps": 3}, is_running=True)
    assert shown(study["trials"][0]["user_attrs"]) == {"environment steps": "3"}
