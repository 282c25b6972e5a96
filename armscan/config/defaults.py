"""Configuration outside Hydra: plain values, default stores, and keys and values that have a meaning of their own."""

from __future__ import annotations

from typing import Any, cast

from omegaconf import DictConfig, ListConfig, OmegaConf

from armscan.config.services import STORAGE, address_of
from armscan.config.sources import config_file, config_folder
from armscan.errors import InvalidValueError

# The rules that options of `armscan evaluate` change, and their keys in the configuration.
CHANGES = {
    "success_threshold": "env.success_threshold",
    "max_steps": "env.max_steps",
    "start": "env.start",
    "clustering": "env.clustering",
    "deterministic_eval": "agent.deterministic_eval",
    "device": "compute.device",
}
RESUME, TRACKING_URI = "resume", "tracking.uri"
# Prints what a study or a grid would run.
PLAN = "--plan"
# The section with services that many machines share.
CLUSTER = "cluster"
# Configuration groups from which every run makes one choice, as its tags tell.
CHOICES = ("data", "obs", "reward", "agent", "network")
# Hydra's options for several runs.
MULTIRUN = ("-m", "--multirun")
# Keys that may differ between runs of the same experiment: how it is computed, tracked and reported, and the seed.
NOT_COMPARED = ("tracking", "device", "compute.device", "seed", "evaluation.on_plane")
# Keys that earlier versions did not have; null is their behaviour.
ADDED = ("training.schedule",)
# Of a cross-validation: the number of folds, and the fold that a run is tested on.
FOLDS, FOLD = "data.folds", "data.fold"
# Prefixes of keys that a study does not search.
NOT_SEARCHED = ("study", "sweep", "tracking", "evaluation", "hydra", "seed")
TRACKING_FILE = "tracking/mlflow.yaml"
# Stands for phantoms where a command takes a folder of volumes.
PHANTOM = "phantom"


def to_plain(config: DictConfig | ListConfig) -> dict[str, Any]:
    """Return a configuration, or a section of one, as plain dictionaries, lists, numbers and strings, all resolved."""
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))


def default_tracking() -> dict[str, Any]:
    """Return the default section `tracking`.

    Raises:
        InvalidValueError: If the user's own file of it names no store.
    """
    file, ours = config_file(TRACKING_FILE), config_folder() / TRACKING_FILE
    section = OmegaConf.load(file)
    if "uri" not in section:
        raise InvalidValueError(f"{file} has no key 'uri', but it replaces {ours}: begin with a copy of that file")
    return to_plain(section)


def default_storage() -> str:
    """Return the default storage of studies."""
    return address_of(STORAGE, "optuna.journal")
