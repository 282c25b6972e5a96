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
    return shlex.join(["python", "-m", "armscan.run", *words])


def resume_command(run_id: str, tracking_uri: str) -> str:
    """Returns what one types to go on with a run that was cut off."""
    return _command("armscan.run", f"{RESUME}={run_id}", TRACKING_URI, tracking_uri)


def evaluate_command(run_id: str, tracking_uri: str) -> str:
    """Returns what one types to judge a run's agent."""
    return _command("armscan.evaluate", f"run={run_id}", "tracking", tracking_uri)


def watch_command(run_id: str, tracking_uri: str) -> str:
    """Returns what one types to film a run's agent."""
    return _command("armscan.watch", f"run={run_id}", "tracking", tracking_uri)


def report_command(study: str, storage: str) -> str:
    """Returns what one types to see what a study has found."""
    return _command_at("armscan.report", f"study={study}", "storage", storage, usual_storage())


def ui_command(*, tracking: str | None = None, storage: str | None = None) -> str:
    """Returns what one types to look at runs and studies in the browser; what is None is where it usually is."""
    usual = {"storage": usual_storage(), "tracking": usual_tracking()["uri"]}
    given = {"storage": storage, "tracking": tracking}
    words = [f"{key}={uri}" for key, uri in given.items() if uri not in (None, usual[key])]
    return shlex.join(["python", "-m", "armscan.ui", *words])


def _command(module: str, of_run: str, key_of_store: str, tracking_uri: str) -> str:
    return _command_at(module, of_run, key_of_store, tracking_uri, usual_tracking()["uri"])


def _command_at(module: str, of_what: str, key_of_place: str, place: str, usual_place: str) -> str:
    where = [] if place == usual_place else [f"{key_of_place}={place}"]
    return shlex.join(["python", "-m", module, of_what, *where])
