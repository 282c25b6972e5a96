"""What is evaluated: the agent of a tracked run, or one that a configuration describes."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from armscan.building import check_sections
from armscan.errors import CheckpointError, InvalidValueError
from armscan.mistakes import CONFIG_MODULE, CONFIG_NAME
from armscan.settings import CHANGES
from armscan.tracking.finding import EVALUATED_TAG, FAMILIAR_TAG, FoundRun, found_run
from armscan.training import Familiar, Fingerprints, Origin, load_weights

# Files and folders that the section `data` names.
PATHS = ("path", "cache_dir")


@dataclass(frozen=True)
class Subject:
    """What is evaluated.

    Args:
        name: what tables and files call it.
        config: resolved, with the changes that were asked for.
        run: that it was trained in, None for an agent that no run is of.
        weights: of a learner, None where it has kept none.
        n_env_steps: that it was trained for.
        familiar: what it was trained on, None where that was not kept.
        volumes: the fingerprints of its run's volumes, None where these were not kept.
    """

    name: str
    config: DictConfig
    run: FoundRun | None = None
    weights: dict[str, Any] | None = field(default=None, repr=False)
    n_env_steps: int = 0
    familiar: Familiar | None = None
    volumes: Fingerprints | None = field(default=None, repr=False)


def subject_of_run(tracking: str, run_id: str, changes: Mapping[str, Any]) -> Subject:
    """Returns the agent of a tracked run.

    Raises:
        ArmscanError: if there is no such run, it has kept too little, or what it has kept is damaged.
    """
    run = found_run(tracking, run_id)
    if EVALUATED_TAG in run.tags:
        raise InvalidValueError(f"run is {run_id!r}, but that is an evaluation, of {run.tags[EVALUATED_TAG]}")
    with tempfile.TemporaryDirectory() as folder:
        config = from_its_folder(changed(OmegaConf.create(run.config(Path(folder))), changes), run.tags)
        weights, facts = _weights(run, Path(folder))
        # Of learners that were trained before runs kept them, the checkpoint has them.
        volumes = run.volumes(Path(folder)) or facts.get("volumes") or None
    familiar = Familiar.from_json(run.tags[FAMILIAR_TAG]) if FAMILIAR_TAG in run.tags else None
    return Subject(run.name, config, run, weights, int(facts.get("n_env_steps", 0)), familiar, volumes)


def subject_of_words(words: Sequence[str], folder: str | None, changes: Mapping[str, Any]) -> Subject:
    """Returns the agent of a configuration, composed as `python -m armscan.run` composes it.

    Args:
        words: `key=value`, `agent=NAME` among them, and `data=nifti` where there is a folder.
        folder: of the volumes that it is evaluated on, which are its own then; None for those of the configuration.
        changes: of the rules.
    """
    GlobalHydra.instance().clear()
    with initialize_config_module(CONFIG_MODULE, version_base="1.3"):
        config = compose(CONFIG_NAME, list(words))
    if folder:
        config.data.path = folder
    OmegaConf.resolve(config)
    agents = [word.partition("=")[2] for word in words if word.startswith("agent=")]
    return Subject(agents[-1], changed(config, changes))


def changed(config: DictConfig, changes: Mapping[str, Any]) -> DictConfig:
    """Returns the configuration with changed rules, by the names in `CHANGES`.

    Raises:
        InvalidValueError: if the configuration has no place for one, or lacks a section.
    """
    check_sections(config)
    for name, value in changes.items():
        section, _, key = CHANGES[name].partition(".")
        if key not in config[section]:
            raise InvalidValueError(f"{name} is {value!r}, but this agent has no such value")
        config[section][key] = value
    return config


def from_its_folder(config: DictConfig, tags: Mapping[str, str]) -> DictConfig:
    """Returns a run's configuration with the files of its data named from anywhere, not from where it was started."""
    for key in PATHS:
        if isinstance(path := config.data.get(key), str) and "working_folder" in tags:
            config.data[key] = str(Path(tags["working_folder"], path))
    return config


def _weights(run: FoundRun, folder: Path) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    path = run.checkpoint(folder)
    if path is None:
        return None, {}
    try:
        weights, facts = load_weights(path)
        Origin(run_id=run.run_id).check(path, facts)
    except CheckpointError as error:
        # The file lies in a folder that is gone when this is read.
        raise CheckpointError(f"run {run.run_id}: {str(error).replace(str(path), path.name)}") from error
    return weights, facts
