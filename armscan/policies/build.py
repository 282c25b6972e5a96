"""A learner's policy as a model: built, compared with the learner, and stored with its run."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mlflow.pyfunc
import numpy as np
import yaml
from numpy.typing import NDArray

import armscan
from armscan.agents import Learner
from armscan.agents.policy import Policy, batch_of
from armscan.agents.torch_export import OBSERVATION
from armscan.envs.actions import STOP
from armscan.envs.rules import Observed
from armscan.errors import ExportError, is_interruption
from armscan.policies.model import ONNX_FILE, Arrays, arrays_of, model_sha256, write_model
from armscan.tracking import TrackedRun
from armscan.tracking.tracking_store import reason_in
from armscan.training.domain import with_crops
from armscan.training.episode_results import Env
from armscan.training.episode_seeds import EXPORT_SEED
from armscan.utils.arrays import FloatArray
from armscan.utils.run_files import CONFIG_FILE, POLICY_FOLDER

# Run tag that says whether the run has a model.
POLICY_TAG = "policy"
KEPT = "kept"
# Run tag with the SHA-256 of the model, by which a replaced model is detected.
SUM_TAG = "policy.sha256"
# Key of the metadata: why the policy answers differently from the agent that was evaluated.
DIFFERS = "differs_from_agent"
# Largest allowed difference of the model from its network; and from the learner and ONNX, which sum in other orders.
TOLERANCE, ROUNDING_TOLERANCE = 1e-6, 1e-5
# Rules of the environment that its observations depend on, besides the observation itself.
OF_OBSERVATION = ("projection", "stack", "memory", "stack_exclude", "stack_memory", "flat", "clustering", "reward")
# Number of observations that a model is checked with.
N_OBSERVED = 8
# Longest time that an ONNX file has for its answers.
MAX_ANSWER_S = 60.0
# onnxruntime's highest level of messages.
FATAL = 4


def save_policy(
    agent: Learner,
    env: Env,
    tracked: TrackedRun,
    folder: Path,
    tell: Callable[[str], None],
    *,
    slice_px: tuple[int, int],
) -> None:
    """Store the policy of a trained agent as a model of its run, unless its configuration disables it.

    If the model cannot be stored, the run goes on: the reason is printed, and noted in a tag.

    Args:
        agent: The trained agent.
        env: Environment of its observations.
        tracked: Run of the agent.
        folder: Folder of the run.
        tell: Function that prints a sentence.
        slice_px: Largest shape that fits into the slices of the run's volumes, which images are cropped to by default.
    """
    config = yaml.safe_load((folder / CONFIG_FILE).read_bytes())
    # Runs of earlier versions do not have the key.
    if not config["tracking"].get("policy", True):
        return
    model = folder / POLICY_FOLDER
    try:
        make_model(agent, env, model, facts_of(config, env, tracked.run_id, slice_px))
    except ExportError as error:
        # A model that the run made before it was interrupted.
        shutil.rmtree(model, ignore_errors=True)
        tell(f"the policy is not kept as a model: {error}")
        tracked.set_tags({POLICY_TAG: f"not kept: {error}"})
    else:
        tracked.log_folder(model)
        tracked.set_tags(tags_of_kept(model))


def tags_of_kept(folder: Path) -> dict[str, str]:
    """Return the tags of a run that keeps the model in this folder."""
    return {SUM_TAG: model_sha256(folder), POLICY_TAG: KEPT}


def make_model(agent: Learner, env: Env, folder: Path, facts: Mapping[str, Any]) -> None:
    """Write an agent's policy as a model, replacing an earlier one; a model that fails a check is not written.

    Args:
        agent: Agent whose policy is written.
        env: Environment of its observations.
        folder: Folder of the model.
        facts: Metadata of the model; see `facts_of`.

    Raises:
        ExportError: If the policy cannot be exported, or the model does not answer as the agent does.
    """
    policy, played = agent.policy(), _played(agent, env)
    batch = batch_of([observation for observation, _ in played])
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as beside:
            made = Path(beside, folder.name)
            write_model(made, policy, batch, {DIFFERS: policy.differs, **facts})
            _check(made, policy, played)
            if folder.exists():
                folder.replace(Path(beside, "before"))
            made.replace(folder)
    except OSError as error:
        raise ExportError(f"{folder}: the model cannot be written ({error.strerror or error})") from error
    # Any exception of MLflow or onnxruntime: a run must not fail because of its model.
    except Exception as error:
        if isinstance(error, ExportError) or is_interruption(error):
            raise
        if f"[Errno {errno.ENOSPC}]" in str(error):
            raise ExportError(f"{folder}: the model cannot be written ({os.strerror(errno.ENOSPC)})") from error
        raise ExportError(f"the model cannot be written or run: {reason_in(error)}") from error


def facts_of(config: Mapping[str, Any], env: Env, run_id: str, slice_px: tuple[int, int]) -> dict[str, Any]:
    """Return the metadata of a model: its origin, its observations, and the meaning of its actions.

    Args:
        config: Resolved configuration of the run.
        env: Environment of the observations.
        run_id: MLflow run ID.
        slice_px: Largest shape that fits into the slices of the run's volumes; see `save_policy`.
    """
    rules = config["env"]
    ways: dict[str, Any] = {"tx": "the volume's size across", "ty": "the volume's size along the arm"}
    if rules["translation_bounds_mm"] is not None:
        ways = dict(zip(ways, rules["translation_bounds_mm"], strict=True))
    turns = zip(("rz", "rx"), rules["rotation_bounds_deg"], strict=True)
    means = {name: f"a times {bound} degrees" for name, bound in turns}
    means |= {name: f"(a + 1) / 2 times {bound}, in mm" for name, bound in ways.items()}
    means[STOP] = "above 0: the episode ends with this plane"
    return {
        "armscan": armscan.__version__,
        "run": run_id,
        **{name: rules[name] for name in OF_OBSERVATION if name in rules},
        "observation": with_crops(rules["observation"], slice_px, slice_px),
        # A list, in the order of the action: MLflow sorts the keys of a mapping.
        "action": [{"component": name, "value": means[name]} for name in env.get_wrapper_attr("action_names")],
    }


def _played(agent: Learner, env: Env) -> list[tuple[Observed, FloatArray]]:
    """Return observations of the agent's episodes, with its action for each."""
    played: list[tuple[Observed, FloatArray]] = []
    seed, is_over = EXPORT_SEED, True
    while len(played) < N_OBSERVED:
        if is_over:
            observation, info = env.reset(seed=seed)
            agent.begin(seed=seed, bounds=env.get_wrapper_attr("scene").bounds)
            seed, reward = seed + 1, float(info["reward"])
        action = agent.act(observation, reward)
        played.append((observation, action))
        observation, received, terminated, truncated, _ = env.step(action)
        reward, is_over = float(received), terminated or truncated
    return played


def _check(folder: Path, policy: Policy, played: list[tuple[Observed, FloatArray]]) -> None:
    """Raise `ExportError` if a model does not answer as the agent did."""
    batch = batch_of([observation for observation, _ in played])
    model = mlflow.pyfunc.load_model(str(folder))
    answers = model.predict(arrays_of(batch))
    _check_same("the model", answers, "its network", policy(batch).numpy(), TOLERANCE)
    if policy.differs is None:
        # One by one, as the agent was asked: torch may sum another batch size in another order.
        alone = np.concatenate([model.predict(arrays_of(batch_of([observation]))) for observation, _ in played])
        _check_same("the model", alone, "the agent", np.stack([action for _, action in played]), ROUNDING_TOLERANCE)
    _check_same("ONNX", onnx_answers(folder / ONNX_FILE, arrays_of(batch)), "the model", answers, ROUNDING_TOLERANCE)


def onnx_answers(file: Path, arrays: Arrays) -> NDArray[np.float32]:
    """Return the actions of onnxruntime for a batch of observations, shape (n, n_action).

    Raises:
        ExportError: If there is no answer within a minute; a file may contain an endless loop.
    """
    # Deferred: few commands need it.
    import onnxruntime

    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    inputs = arrays if isinstance(arrays, dict) else {OBSERVATION: arrays}
    options = onnxruntime.RunOptions()
    # Errors are raised; onnxruntime would print them, too.
    options.log_severity_level = FATAL
    limit = threading.Timer(MAX_ANSWER_S, setattr, (options, "terminate", True))
    limit.start()
    try:
        (answers,) = session.run(None, inputs, options)
    # onnxruntime raises the same class for all errors of a run.
    except Exception as error:
        if options.terminate:
            raise ExportError(f"{file.name} has not answered within {MAX_ANSWER_S:g} s") from error
        raise
    finally:
        limit.cancel()
    actions: NDArray[np.float32] = answers
    return actions


def _check_same(what: str, given: NDArray[Any], of: str, wanted: NDArray[Any], tolerance: float) -> None:
    furthest = float(np.abs(given - wanted).max())
    # `not <=`, so that NaN is refused too.
    if not furthest <= tolerance:
        raise ExportError(f"{what} differs from {of} by up to {furthest:.3g}, but {tolerance:g} is allowed")
