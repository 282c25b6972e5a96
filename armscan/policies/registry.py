"""Policies of tracked runs: made from their checkpoints, and registered in MLflow's model registry."""

from __future__ import annotations

import logging
import tempfile
from functools import cache, partial
from pathlib import Path

import mlflow.pyfunc
from mlflow.exceptions import MlflowException

from armscan import judging
from armscan.agents import Learner
from armscan.errors import ExportError, InvalidValueError
from armscan.files import POLICY_FOLDER
from armscan.judging import Subject
from armscan.policies.card import Card
from armscan.policies.making import SUM_TAG, facts_of, make_model, tags_of_kept
from armscan.policies.model import sum_of_model
from armscan.settings import plain
from armscan.tracking import FoundRun, check_artifacts, found_run
from armscan.tracking.client import reason_in
from armscan.tracking.run import MODEL_FILE
from armscan.tracking.store import usable_store
from armscan.training import TEST

MAX_NAME_CHARS = 256
# However a run has computed and was judged, its policy is asked in 32 bits on the CPU for its most likely action.
PLAIN_COMPUTE = {"device": "cpu", "precision": "float32", "compile": False}


def export_policy(tracking: str, run_id: str, folder: Path) -> FoundRun:
    """Makes a model of a tracked run's policy from its checkpoint; returns the run.

    Args:
        tracking: address of the store.
        run_id: of the run, or its beginning.
        folder: of the model.

    Raises:
        ArmscanError: if there is no such run, it has trained nothing, or its checkpoint or volumes are not to be had.
    """
    subject = judging.subject_of_run(tracking, run_id, {})
    assert subject.run is not None
    _as_it_is(subject)
    own = cache(partial(judging.own_split, subject, ("training", "test")))
    trial = judging.prepare(subject, {TEST: own().test}, judging.TrainingVolumes(own))
    if not isinstance(trial.agent, Learner):
        raise InvalidValueError(f"run is {run_id!r}, but its agent is none that learns: it has no policy")
    env = trial.envs[TEST]
    make_model(trial.agent, env, folder, facts_of(plain(subject.config), env, subject.run.run_id))
    return subject.run


def _as_it_is(subject: Subject) -> None:
    subject.config.compute.update(PLAIN_COMPUTE)
    if "judged_by_sampling" in subject.config.agent:
        subject.config.agent.judged_by_sampling = False


def register_policy(tracking: str, run_id: str, name: str) -> str:
    """Registers the policy of a tracked run, which is made from its checkpoint where the run has kept none.

    One that was kept without its sum, by an earlier version, is made anew.

    Args:
        tracking: address of the store, whose model registry it goes to.
        run_id: of the run, or its beginning.
        name: of the registered model, which is made where there is none.

    Returns:
        The address of its new version, as MLflow takes it.

    Raises:
        ArmscanError: if the name is none, or the run has no policy that answers, or another one than it has kept.
    """
    _check_name(name)
    run = found_run(tracking, run_id)
    with tempfile.TemporaryDirectory() as beside, usable_store(run.uri):
        folder = Path(beside, POLICY_FOLDER)
        if is_kept := _is_kept(run):
            _check_kept(run, Path(run.client.download_artifacts(run.run_id, POLICY_FOLDER, beside)))
        else:
            check_artifacts(run.client, run.experiment_id)
            export_policy(tracking, run_id, folder)
        card = Card.of(run, Path(beside))
        if not is_kept:
            run.client.log_artifacts(run.run_id, str(folder), POLICY_FOLDER)
            for tag, value in tags_of_kept(folder).items():
                run.client.set_tag(run.run_id, tag, value)
        return _registered(run, name, card)


def _check_name(name: str) -> None:
    """Raises `InvalidValueError` for a name that MLflow, or its database, refuses."""
    if not name.strip() or set("/:") & set(name) or name == "." or name.startswith("..") or len(name) > MAX_NAME_CHARS:
        raise InvalidValueError(
            f"name is {name!r}, but it must be a text of at most {MAX_NAME_CHARS} characters without '/' and ':', "
            "other than '.', and not beginning with '..'"
        )


def _is_kept(run: FoundRun) -> bool:
    if SUM_TAG not in run.tags or POLICY_FOLDER not in run.files:
        return False
    return f"{POLICY_FOLDER}/{MODEL_FILE}" in [
        each.path for each in run.client.list_artifacts(run.run_id, POLICY_FOLDER)
    ]


def _check_kept(run: FoundRun, folder: Path) -> None:
    """Raises `ExportError` for a model that is not the one that its run has kept, or that does not answer."""
    # Before it is loaded, which runs the code that lies in it.
    if sum_of_model(folder) != run.tags[SUM_TAG]:
        raise _not_kept(run)
    # What it tells of a program that it cannot read is raised as well.
    logging.getLogger("torch.export").setLevel(logging.CRITICAL)
    try:
        model = mlflow.pyfunc.load_model(str(folder))
        model.predict(model.input_example)
    # Whatever is wrong with its files.
    except Exception as error:
        raise ExportError(
            f"run {run.run_id}: its {POLICY_FOLDER}/ is damaged, it does not answer its own example: {reason_in(error)}"
        ) from error
    # A sum that was copied from another run together with its model.
    if (model.metadata.metadata or {}).get("run") != run.run_id:
        raise _not_kept(run)


def _not_kept(run: FoundRun) -> ExportError:
    return ExportError(
        f"run {run.run_id}: its {POLICY_FOLDER}/ is not the one that it has kept: changed, or another run's; remove "
        "it from its artifacts, and it is made anew"
    )


def _registered(run: FoundRun, name: str, card: Card) -> str:
    source = f"{run.client.get_run(run.run_id).info.artifact_uri}/{POLICY_FOLDER}"
    try:
        run.client.create_registered_model(name)
    except MlflowException as error:
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise
    version = run.client.create_model_version(name, source, run.run_id, tags=card.tags, description=card.text)
    return f"models:/{name}/{version.version}"
