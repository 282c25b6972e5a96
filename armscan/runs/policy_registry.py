"""Export the policy of a tracked run from its checkpoint, and register it in MLflow's model registry."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sized
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from mlflow.exceptions import MlflowException
from mlflow.models import Model

from armscan.agents import Learner
from armscan.agents.policy import SAMPLING
from armscan.config.defaults import to_plain
from armscan.errors import ExportError, InvalidValueError
from armscan.evaluation import agent_of_run, own_split, prepare_on_volumes
from armscan.policies.build import DIFFERS, SUM_TAG, facts_of, make_model, onnx_answers, tags_of_kept
from armscan.policies.model import ONNX_FILE, model_sha256
from armscan.runs.model_card import Card
from armscan.tracking import FoundRun, check_artifacts, load_run
from armscan.tracking.logged_model import VERSIONS_TAG, model_of
from armscan.tracking.run import MODEL_FILE
from armscan.tracking.store import store_errors
from armscan.tracking.tracking_store import reason_in
from armscan.training import TEST, TrainingDomain
from armscan.utils.console import print_sentence
from armscan.utils.run_files import POLICY_FOLDER

MAX_NAME_CHARS = 256
# The alias of the latest version: `models:/NAME@champion`.
CHAMPION = "champion"
# The tag of a version that names MLflow's logged model of the same checkpoint.
MODEL_TAG = "logged_model"
# A policy computes its deterministic action in 32 bits on the CPU, however the run trained and evaluated it.
PLAIN_COMPUTE = {"device": "cpu", "precision": "float32", "compile": False}


def export_policy(tracking: str, run_id: str, folder: Path, *, trust: bool = False) -> FoundRun:
    """Write the policy of a tracked run as a model, from its checkpoint; return the run.

    Args:
        tracking: MLflow tracking URI.
        run_id: MLflow run ID, or its first characters.
        folder: Folder of the model.
        trust: Whether its configuration may name classes that are not armscan's. Default: False.

    Raises:
        ArmscanError: If there is no such run, its agent does not learn, or its checkpoint or volumes are missing.
    """
    source = agent_of_run(tracking, run_id, {}, trust=trust)
    assert source.run is not None
    source.config.compute.update(PLAIN_COMPUTE)
    is_sampling = not source.config.agent.get("deterministic_eval", True)
    if is_sampling:
        source.config.agent.deterministic_eval = True
    own = cache(partial(own_split, source, ("training", "test")))
    evaluator = prepare_on_volumes(source, {TEST: own().test}, own)
    if source.code_note:
        print_sentence(f"note: {source.code_note}")
    if not isinstance(evaluator.agent, Learner):
        raise InvalidValueError(f"run is {run_id!r}, but its agent does not learn and has no policy")
    env = evaluator.envs[TEST]
    slice_px = (source.domain or TrainingDomain.of(env)).slice_px
    facts = facts_of(to_plain(source.config), env, source.run.run_id, slice_px)
    if is_sampling:
        # The model is compared with deterministic actions, but the run's figures are of sampled ones.
        facts[DIFFERS] = SAMPLING
    make_model(evaluator.agent, env, folder, facts)
    return source.run


def register_policy(tracking: str, run_id: str, name: str, *, trust: bool) -> str:
    """Register the policy of a tracked run, exporting it from the checkpoint if the run has none with a SHA-256.

    Args:
        tracking: MLflow tracking URI, whose model registry is used.
        run_id: MLflow run ID, or its first characters.
        name: Name of the registered model; created if it does not exist.
        trust: Whether its configuration may name classes that are not armscan's, if the policy must be exported.

    Returns:
        The URI of the new version, `models:/NAME/VERSION`.

    Raises:
        ArmscanError: If the name is not allowed, or the run's policy is missing, damaged or has been replaced.
    """
    _check_name(name)
    run = load_run(tracking, run_id)
    with tempfile.TemporaryDirectory() as beside, store_errors(run.uri):
        folder = Path(beside, POLICY_FOLDER)
        if is_kept := _is_kept(run):
            _check_kept(run, Path(run.store.download_artifacts(run.run_id, POLICY_FOLDER, beside)))
        else:
            check_artifacts(run.store, run.experiment_id)
            export_policy(tracking, run_id, folder, trust=trust)
        differs = (Model.load(str(folder)).metadata or {}).get(DIFFERS)
        card = Card.of(run, Path(beside), differs)
        if not is_kept:
            run.store.log_artifacts(run.run_id, str(folder), POLICY_FOLDER)
            for tag, value in tags_of_kept(folder).items():
                run.store.set_tag(run.run_id, tag, value)
        return _registered(run, name, card)


def _check_name(name: str) -> None:
    """Raise `InvalidValueError` for a name that MLflow, or its database, refuses."""
    if not name.strip() or set("/:") & set(name) or name == "." or name.startswith("..") or len(name) > MAX_NAME_CHARS:
        raise InvalidValueError(
            f"--name is {name!r}, but it must be a string of at most {MAX_NAME_CHARS} characters without '/' and ':', "
            "other than '.', and not beginning with '..'"
        )


def _is_kept(run: FoundRun) -> bool:
    files = run.store.list_artifacts(run.run_id, POLICY_FOLDER) if POLICY_FOLDER in run.files else []
    return SUM_TAG in run.tags and f"{POLICY_FOLDER}/{MODEL_FILE}" in [file.path for file in files]


def _check_kept(run: FoundRun, folder: Path) -> None:
    """Raise `ExportError` if a model is not the one that its run saved, or its ONNX file cannot predict.

    The model itself is not loaded, because that executes the code in it.
    """
    if model_sha256(folder) != run.tags[SUM_TAG]:
        raise _not_kept(run)
    try:
        facts = _checked_facts(folder)
    # A damaged file may raise anything.
    except Exception as error:
        raise ExportError(
            f"run {run.run_id}: its {POLICY_FOLDER}/ is damaged or does not answer its own example: {reason_in(error)}"
        ) from error
    # A SHA-256 may have been copied from another run together with its model.
    if facts.get("run") != run.run_id:
        raise _not_kept(run)


def _checked_facts(folder: Path) -> dict[str, Any]:
    """Return the metadata of a model, whose ONNX file answers the model's example."""
    model = Model.load(str(folder))
    facts = dict(model.metadata or {})
    example: Any = model.load_input_example(str(folder))
    if not isinstance(action := facts.get("action"), Sized):
        raise ExportError(f"the action in its metadata is {action!r}, but it must name its components")
    answers = onnx_answers(folder / ONNX_FILE, example)
    n_observations = len(next(iter(example.values())) if isinstance(example, dict) else example)
    if answers.shape != (n_observations, len(action)) or not np.isfinite(answers).all():
        raise ExportError(f"for each observation, it must give as many finite numbers as the action has: {len(action)}")
    if not isinstance(facts.get(DIFFERS, ""), str | None):
        raise ExportError(f"its {DIFFERS} must be a string")
    return facts


def _not_kept(run: FoundRun) -> ExportError:
    return ExportError(
        f"run {run.run_id}: its {POLICY_FOLDER}/ differs from the one that the run saved: changed, or another run's; "
        "remove it from the artifacts, and it is exported again"
    )


def _registered(run: FoundRun, name: str, card: Card) -> str:
    source = f"{run.store.get_run(run.run_id).info.artifact_uri}/{POLICY_FOLDER}"
    try:
        run.store.create_registered_model(name)
    except MlflowException as error:
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise
    model = model_of(run.store.mlflow, run.store.get_run(run.run_id))
    tags = card.tags | ({MODEL_TAG: model.model_id} if model else {})
    version = run.store.create_model_version(name, source, run.run_id, tags=tags, description=card.text)
    run.store.set_registered_model_alias(name, CHAMPION, version.version)
    if model:
        registered = [*json.loads(model.tags.get(VERSIONS_TAG, "[]")), {"name": name, "version": str(version.version)}]
        run.store.set_logged_model_tags(model.model_id, {VERSIONS_TAG: json.dumps(registered)})
    return f"models:/{name}/{version.version}"
