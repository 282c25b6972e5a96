"""Runs, checkpoints and studies left by the version before the keys were renamed."""

import json
import sqlite3
import tarfile
from pathlib import Path

import mlflow
import pytest
from omegaconf import OmegaConf

from armscan.config.compose import compose
from armscan.config.error_messages import one_line_message
from armscan.config.legacy import INVERTED, RENAMED_KEYS, RENAMED_TARGETS, migrate, rename_hint

ARCHIVE = Path(__file__).parents[1] / "data" / "legacy" / "runs.tar.xz"
FINISHED, KILLED = "e56cb34ab4c84623a846ab7cb28eda2b", "6f96be24381b433fabb756416f950769"
AGENTS = ("sac", "ppo", "regression", "optuna", "plane_finder")


@pytest.fixture
def legacy(tmp_path, monkeypatch):
    """Unpack the folder in which the earlier version was used, and work there; return the address of its store."""
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    folder = tmp_path / "legacy"
    for file in (folder / "mlruns.sql", folder / "optuna.journal", *folder.glob("runs/*/tracking/*.jsonl")):
        file.write_text(file.read_text().replace("/FOLDER", str(folder)))
    # The uploaded part of an outbox is given in bytes.
    for file in folder.glob("runs/*/tracking/*.delivered.json"):
        longer = len(str(folder)) - len("/FOLDER")
        file.write_text(json.dumps({name: end + longer for name, end in json.loads(file.read_text()).items()}))
    with sqlite3.connect(folder / "mlruns.db") as database:
        database.executescript((folder / "mlruns.sql").read_text())
    database.close()
    monkeypatch.chdir(folder)
    return f"sqlite:///{folder}/mlruns.db"


def keys_of(config, path=""):
    for name, value in config.items():
        yield f"{path}{name}"
        if isinstance(value, dict):
            yield from keys_of(value, f"{path}{name}.")


def test_every_new_name_is_a_key_of_the_configuration():
    keys = {key for agent in AGENTS for key in keys_of(OmegaConf.to_container(compose([f"agent={agent}"])))}
    assert set(RENAMED_KEYS.values()) <= keys
    assert not set(RENAMED_KEYS) & keys


@pytest.mark.parametrize("old", RENAMED_KEYS)
@pytest.mark.parametrize("added", ["", "+"])
def test_old_key_on_the_command_line_is_answered_with_the_new_one(old, added):
    new, words = RENAMED_KEYS[old], [f"{added}{old}=1"]
    if added:
        assert rename_hint(old).startswith(f"{old} has been renamed: give {new}")
        return
    with pytest.raises(Exception, match="Could not override") as raised:
        compose(words)
    opposite = ", which means the opposite" if old in INVERTED else ""
    assert one_line_message(raised.value) == f"{old} has been renamed: give {new}{opposite}"


def test_configuration_of_this_version_is_not_changed():
    config = OmegaConf.to_container(compose([]))
    assert migrate(config) == config


@pytest.mark.parametrize("target", RENAMED_TARGETS.values())
def test_classes_that_were_renamed_are_there(target):
    from hydra.utils import get_class

    assert get_class(target).__module__.startswith("armscan.")


def test_leaves_are_migrated_as_the_whole_is():
    leaves = {"env._target_": "armscan.envs.EnvMaker", "env.delta": "0.05", "agent.judged_by_sampling": "False"}
    assert migrate(leaves) == {
        "env._target_": "armscan.envs.EnvFactory",
        "env.success_threshold": "0.05",
        "agent.deterministic_eval": "True",
    }
    nested = {"env": {"_target_": "armscan.envs.EnvMaker", "delta": 0.05}, "agent": {"judged_by_sampling": False}}
    assert migrate(nested) == {
        "env": {"_target_": "armscan.envs.EnvFactory", "success_threshold": 0.05},
        "agent": {"deterministic_eval": True},
    }


def test_finished_run_is_made_again_with_the_same_metrics(legacy, tmp_path):
    from armscan.runs.reproduce import load_original, reproduce

    comparison = reproduce(load_original(legacy, FINISHED), tmp_path / "again", [])
    # Their values differ: SAC draws its batches in another way, and adds in another order.
    assert len(comparison.differences) == 47
    for difference in comparison.differences:
        assert (difference.n_missing, difference.n_new) == (0, 0)


def test_weights_of_a_finished_run_play_its_final_episodes_again(legacy, tmp_path):
    from armscan.experiment.results import RunResult
    from armscan.runs.reproduce import load_original
    from armscan.training import load_weights

    original = load_original(legacy, FINISHED)
    original.setup.agent.load_weights(load_weights(original.run.checkpoint(tmp_path))[0])
    tracked = mlflow.MlflowClient(legacy).get_run(FINISHED).data.metrics
    for name, evaluation in RunResult.of(original.setup, None).evaluations.items():
        then = {key: value for key, value in tracked.items() if key.startswith(name.replace(" ", "_"))}
        assert len(then) > 8
        for key, value in then.items():
            # Another kind of processor adds in another order.
            assert evaluation.metrics()[key.partition("/")[2]] == pytest.approx(value, rel=1e-4, abs=1e-4), key


def test_killed_run_is_resumed_and_its_policy_exported(legacy, tmp_path):
    from armscan.experiment.resume import resume_run
    from armscan.runs.policy_registry import export_policy
    from armscan.tracking import open_existing_store

    metrics = resume_run(open_existing_store(legacy), KILLED)
    assert metrics["test volumes"]["episodes"] == 2
    run = mlflow.MlflowClient(legacy).get_run(KILLED)
    assert (run.info.status, run.data.tags["resumed"]) == ("FINISHED", "1")
    assert run.data.params["agent.judged_by_sampling"] == "True"
    assert "agent.deterministic_eval" not in run.data.params
    export_policy(legacy, KILLED, tmp_path / "policy")
    policy = mlflow.pyfunc.load_model(str(tmp_path / "policy"))
    assert policy.predict(policy.input_example).shape == (2, 1)


def test_old_and_new_runs_have_the_same_keys_in_a_comparison(legacy, tmp_path):
    from armscan.reports.load import read_trainings
    from armscan.tracking import open_existing_store

    store = open_existing_store(legacy)
    (training,) = read_trainings(store, [store.get_run(FINISHED)], tmp_path)
    assert training.params["agent.learning_starts"] == "200"
    assert not set(training.params) & set(RENAMED_KEYS)


def test_values_of_an_old_trial_are_given_by_their_new_names():
    from armscan.sweeps.space.parameter import overrides_of

    assert overrides_of({"agent.updates_per_env_step": 0.5, "agent.lr": 0.1}) == ["agent.utd_ratio=0.5", "agent.lr=0.1"]


@pytest.mark.parametrize("config", [{"agent": {"astray_share": 0.2}}, {"agent.astray_share": 0.2}])
def test_key_that_was_renamed_later_is_migrated_alone(config):
    schedule = {"training": {"schedule": [{"from_env_steps": 8, "agent.astray_share": 0.1}]}}
    renamed = {"training": {"schedule": [{"from_env_steps": 8, "agent.perturbed_share": 0.1}]}}
    assert migrate(config | schedule).items() >= renamed.items()
    new = {"agent": {"perturbed_share": 0.2}} if "agent" in config else {"agent.perturbed_share": 0.2}
    assert migrate(config) == new
    assert migrate(new) == new
