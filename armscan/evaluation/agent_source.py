"""The agent to evaluate: from a tracked run, or from a configuration."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from armscan.config.compose import compose
from armscan.config.defaults import CHANGES, to_plain
from armscan.config.own_code import changed_modules, own_code
from armscan.errors import CheckpointError, InvalidValueError, few
from armscan.evaluation.report import assigned
from armscan.experiment.build import check_keys, check_sections
from armscan.tracking.lookup import FoundRun, load_agent_run
from armscan.tracking.tags import DOMAIN_TAG, OWN_CODE_TAG, WORKING_FOLDER_TAG
from armscan.training import CheckpointProvenance, Fingerprints, TrainingDomain, load_weights

# Keys of the section `data` that hold paths.
PATHS = ("path", "cache_dir")
MAX_ENV_STEPS = 10**15


@dataclass(frozen=True)
class EvaluatedAgent:
    """Configuration of an agent to evaluate, and its weights if a run has trained it.

    Args:
        name: Name of the agent in tables and files.
        config: Resolved configuration, with the requested changes.
        run: Run that trained it; None for an agent without a run.
        weights: Weights of a learner; None if its run has none.
        n_env_steps: Environment steps at the end of its best epoch, which the weights are from. Default: 0.
        domain: Training domain; None if its run has none.
        volumes: Fingerprints of its run's volumes; None if the run has none.
        changes: Changed rules, by the names in `CHANGES`. Default: none.
    """

    name: str
    config: DictConfig
    run: FoundRun | None = None
    weights: dict[str, Any] | None = field(default=None, repr=False)
    n_env_steps: int = 0
    domain: TrainingDomain | None = None
    volumes: Fingerprints | None = field(default=None, repr=False)
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def changed_rules(self) -> list[str]:
        """Changed rules as they are shown, such as `max_steps=3`."""
        return assigned(self.changes)

    @property
    def code_note(self) -> str | None:
        """Note on the code of own classes that has changed since the run; None if none has."""
        then = self.run.tags.get(OWN_CODE_TAG) if self.run else None
        changed = changed_modules(then, own_code(to_plain(self.config)))
        return f"the code of {few(changed)} has changed since the run" if changed else None


def agent_of_run(tracking: str, run_id: str, changes: Mapping[str, Any], *, trust: bool = False) -> EvaluatedAgent:
    """Return the agent of a tracked run.

    Args:
        tracking: MLflow tracking URI.
        run_id: MLflow run ID, or its first characters.
        changes: Changed rules, by the names in `CHANGES`.
        trust: Whether its configuration may name classes that are not armscan's. Default: False.

    Raises:
        ArmscanError: If there is no such run, or its artifacts are missing or damaged.
    """
    run = load_agent_run(tracking, run_id)
    with tempfile.TemporaryDirectory() as folder:
        config = from_its_folder(changed(OmegaConf.create(run.config(Path(folder), trust=trust)), changes), run.tags)

        weights, facts = _weights(run, Path(folder))
        # Older runs of learners have them in the checkpoint only.
        volumes = run.volumes(Path(folder)) or facts.get("volumes") or None
    domain = TrainingDomain.from_json(run.tags[DOMAIN_TAG]) if DOMAIN_TAG in run.tags else None
    return EvaluatedAgent(run.name, config, run, weights, _n_env_steps(facts, run.run_id), domain, volumes, changes)


def _n_env_steps(facts: Mapping[str, Any], run_id: str) -> int:
    n_env_steps = facts.get("n_env_steps", 0)
    if type(n_env_steps) is not int or not 0 <= n_env_steps <= MAX_ENV_STEPS:
        raise CheckpointError(
            f"run {run_id}: the n_env_steps of its checkpoint must be a whole number from 0 to {MAX_ENV_STEPS}"
        )
    return n_env_steps


def agent_of_overrides(overrides: Sequence[str], folder: str | None, changes: Mapping[str, Any]) -> EvaluatedAgent:
    """Return the agent of a configuration, composed as `armscan run` composes it.

    Args:
        overrides: Overrides `key=value`, with `agent=NAME`, and with `data=nifti` if there is a folder.
        folder: Folder of the volumes to evaluate on, which also count as its own. None: the volumes of the
            configuration.
        changes: Changed rules, by the names in `CHANGES`.
    """
    config = compose(overrides)
    check_keys(config)
    if folder:
        config.data.path = folder
    OmegaConf.resolve(config)
    agents = [override.partition("=")[2] for override in overrides if override.startswith("agent=")]
    return EvaluatedAgent(agents[-1], changed(config, changes), changes=changes)


def changed(config: DictConfig, changes: Mapping[str, Any]) -> DictConfig:
    """Return the configuration with changed rules, by the names in `CHANGES`.

    Raises:
        InvalidValueError: If the configuration lacks such a key, or a section.
    """
    check_sections(config)
    for name, value in changes.items():
        section, _, key = CHANGES[name].partition(".")
        if key not in config[section]:
            raise InvalidValueError(f"{name} is {value!r}, but this agent has no such value")
        config[section][key] = value
    return config


def from_its_folder(config: DictConfig, tags: Mapping[str, str]) -> DictConfig:
    """Return a run's configuration with the paths of its data made absolute, from the folder where it was started."""
    for key in PATHS:
        if isinstance(path := config.data.get(key), str) and WORKING_FOLDER_TAG in tags:
            config.data[key] = str(Path(tags[WORKING_FOLDER_TAG], path))
    return config


def _weights(run: FoundRun, folder: Path) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    path = run.checkpoint(folder)
    if path is None:
        return None, {}
    try:
        weights, facts = load_weights(path)
        CheckpointProvenance(run_id=run.run_id).check(path, facts)
    except CheckpointError as error:
        # The file's temporary folder is gone by the time the message is read.
        raise CheckpointError(f"run {run.run_id}: {str(error).replace(str(path), path.name)}") from error
    return weights, facts
