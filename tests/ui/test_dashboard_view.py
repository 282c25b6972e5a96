"""What a person sees of armscan's trials in Optuna's dashboard."""

import json
import urllib.request

import optuna
import pytest

from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.dashboard import LOCAL_UI, note_run
from armscan.ui.servers import start_dashboard
from tests.ui.test_ui import free_ports

MLFLOW = "http://127.0.0.1:5123"
LEASE = {"worker": "here-1", "pid": 12, "started": "x", "beat": 3, "seed": 1, "env_steps": 700, "return": -8.123456}
KEPT = {
    "lease": LEASE,
    "env_steps": 900,
    "figures": {"mean_steps": 3.0},
    "seeds": {"0": {"mean_steps": 3.0}},
    "config_sha256": "0" * 64,
    "mlflow_run": "1" * 32,
    "folder": "studies/a/trials/0000",
}


class Store:
    uri = "sqlite:///mlruns.db"


@pytest.fixture
def dashboard(tmp_path):
    """Makes a study with such attributes; returns what the dashboard answers of it."""

    def made(of_study, of_trial, *, is_running=False):
        storage = open_storage(str(tmp_path / "optuna.journal"))
        study = optuna.create_study(study_name="a", storage=storage.optuna)
        for name, value in of_study.items():
            study.set_user_attr(name, value)
        trial = study.ask()
        for name, value in of_trial.items():
            trial.set_user_attr(name, value)
        note_run(trial, Store, "1", "1" * 32, tmp_path, {0: {"mean_steps": 3.0}})
        if not is_running:
            study.tell(trial, 1.0)
        port, _ = free_ports()
        address = start_dashboard(storage, tmp_path, port, mlflow=MLFLOW)
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
    assert "| steps, mean | 3 |" in note


def test_studies_of_others_are_shown_as_they_are(dashboard):
    _, study = dashboard({"space": "theirs"}, {"folder": "mine", "figures": [1]})
    assert shown(study["trials"][0]["user_attrs"]) == {"folder": "mine", "figures": "[1]"}
    assert shown(study["user_attrs"]) == {"space": "theirs"}


@pytest.mark.parametrize("lease", ["{", "[1]", [1], 3])
def test_lease_that_is_none_hides_no_study(dashboard, lease):
    _, study = dashboard({}, {"lease": lease, "env_steps": 3}, is_running=True)
    assert shown(study["trials"][0]["user_attrs"]) == {"environment steps": "3"}
