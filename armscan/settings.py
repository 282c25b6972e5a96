"""The configuration outside Hydra: as plain values, and what it says of the tracking store where nothing else does."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from importlib import resources
from typing import Any, cast

from omegaconf import DictConfig, ListConfig, OmegaConf

from armscan.mistakes import CONFIG_MODULE
from armscan.services import STORAGE, address_of

# The rules that an evaluation may change in one word, and where they stand in the configuration.
CHANGES = {
    "delta": "env.delta",
    "max_steps": "env.max_steps",
    "start": "env.start",
    "clustering": "env.clustering",
    "judged_by_sampling": "agent.judged_by_sampling",
    "device": "compute.device",
}
RESUME, TRACKING_URI = "resume", "tracking.uri"
# What names a study, and the option that only shows what it would run.
SWEEPS, PLAN = "sweeps", "--plan"
# The services that many machines share.
CLUSTER = "cluster"
# Hydra's options for several runs.
MULTIRUN = ("-m", "--multirun")
# What says where and how things are computed and kept, not what; and the seed, by which runs of the same thing differ.
NOT_COMPARED = ("tracking", "device", "compute.device", "seed")
# The phantoms, where a command asks for volumes.
PHANTOM = "phantom"


def plain(config: DictConfig | ListConfig) -> dict[str, Any]:
    """Returns a configuration, or a section of one, as plain dictionaries, lists, numbers and texts, all resolved.

    Raises:
        MissingMandatoryValue: if a value that must be given is not.
    """
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))


def usual_tracking() -> dict[str, Any]:
    """Returns the section `tracking` as it is where nobody says anything else."""
    with (resources.files(CONFIG_MODULE) / "tracking" / "mlflow.yaml").open() as file:
        return plain(OmegaConf.load(file))


def usual_storage() -> str:
    """Returns where studies are kept where nobody says anything else; without a password."""
    return address_of(STORAGE, "optuna.journal")


def run_command(words: Iterable[str]) -> str:
    """Returns what one types to run what words describe."""
    return _command("armscan.run", *words)


def resume_command(run_id: str, tracking_uri: str) -> str:
    """Returns what one types to go on with a run that was cut off."""
    return _command("armscan.run", f"{RESUME}={run_id}", tracking=tracking_uri, key=TRACKING_URI)


def evaluate_command(run_id: str, tracking_uri: str) -> str:
    """Returns what one types to judge a run's agent."""
    return _command("armscan.evaluate", f"run={run_id}", tracking=tracking_uri)


def watch_command(run_id: str, tracking_uri: str) -> str:
    """Returns what one types to film a run's agent."""
    return _command("armscan.watch", f"run={run_id}", tracking=tracking_uri)


def reproduce_command(run_id: str, tracking_uri: str) -> str:
    """Returns what one types to make a run again."""
    return _command("armscan.reproduce", run_id, tracking=tracking_uri)


def report_command(study: str, storage: str) -> str:
    """Returns what one types to see what a study has found."""
    return _command("armscan.report", f"study={study}", storage=storage)


def compare_command(run_id: str, tracking_uri: str) -> str:
    """Returns what one types to compare the trainings below a run."""
    return _command("armscan.report", f"runs={run_id}", tracking=tracking_uri)


def ui_command(*, tracking: str | None = None, storage: str | None = None) -> str:
    """Returns what one types to look at runs and studies in the browser; what is None is where it usually is."""
    return _command("armscan.ui", tracking=tracking, storage=storage)


def _command(
    module: str, *words: str, tracking: str | None = None, storage: str | None = None, key: str = "tracking"
) -> str:
    """Returns a command; places stand in it only where they are not the usual ones."""
    where = [f"storage={storage}"] if storage is not None and storage != usual_storage() else []
    where += [f"{key}={tracking}"] if tracking is not None and tracking != usual_tracking()["uri"] else []
    return shlex.join(["python", "-m", module, *words, *where])
