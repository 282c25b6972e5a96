"""What a run is made of, kept with it from its start: configuration, volumes, code, packages, command."""

from __future__ import annotations

import json
import socket
from collections.abc import Mapping
from operator import methodcaller
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig

import armscan
from armscan.files import (
    CONFIG_FILE,
    DIFF_FILE,
    ENVIRONMENT_FILE,
    RESULTS,
    SUM_TAGS,
    VOLUMES_FILE,
    sum_of,
    write_whole,
)
from armscan.invocation import Invocation
from armscan.multirun import JOB_TAG
from armscan.settings import plain
from armscan.stage import Stage
from armscan.tracking import (
    FAMILIAR_TAG,
    VERSION_TAG,
    TrackedRun,
    deliver_leftovers,
    environment_file,
    environment_tags,
    open_store,
    source,
    tags_of,
)
from armscan.training import Familiar, Fingerprints

CHOICES_IN_TAGS = ("data", "obs", "reward", "agent", "network")
# Of a volume's fingerprint in a tag; the whole stands in a file.
N_PRINT_CHARS = 16


def start_tracking(
    config: DictConfig, invocation: Invocation, stage: Stage, *, patience_s: float | None = None
) -> TrackedRun:
    """Writes down what is run, opens the tracking store and starts a run in it; see `open_store`.

    What an earlier run has made in the folder is replaced; `check_free` has found that it is a run's.
    """
    resolved = plain(config)
    client, experiment_id = open_store(**resolved["tracking"], patience_s=patience_s)
    deliver_leftovers(client)
    choices, job = invocation.choices, invocation.job
    files = started_with(resolved, stage)
    # Those of an earlier run, left in a folder that somebody named: they would be taken for this one's.
    for stale in RESULTS:
        (invocation.folder / stale).unlink(missing_ok=True)
    # Before the run is there: whenever it is killed, it can be resumed.
    for name, contents in files.items():
        write_whole(invocation.folder / name, methodcaller("write", contents))
    tracked = TrackedRun.start(
        client,
        experiment_id,
        name=run_name(resolved, choices),
        config=resolved,
        tags={
            **environment_tags(),
            "command": invocation.command,
            "seed": str(resolved["seed"]),
            "overrides": " ".join(invocation.overrides),
            **{f"choice.{group}": choices[group] for group in CHOICES_IN_TAGS},
            **volume_tags(stage.fingerprints),
            # Where it is applied to other volumes, later, the agent must see what it has learned to see.
            FAMILIAR_TAG: Familiar.of(stage.training_env, stage.experiment.smallest_slice_px).to_json(),
            **place_tags(invocation.folder),
            "working_folder": str(Path.cwd()),
            **sum_tags(files),
            **({JOB_TAG: str(job.number)} if job else {}),
        },
        folder=invocation.folder,
        parent_id=job.parent_run_id if job else None,
    )
    tracked.log_files(*(invocation.folder / name for name in files))
    return tracked


def started_with(config: dict[str, Any], stage: Stage) -> dict[str, bytes]:
    """Returns the files that say what a run was started with, by their names: configuration, volumes, code."""
    diff = source().diff
    return {
        CONFIG_FILE: yaml.safe_dump(config, sort_keys=False).encode(),
        VOLUMES_FILE: json.dumps(stage.fingerprints, indent=1).encode(),
        ENVIRONMENT_FILE: environment_file(),
        **({DIFF_FILE: diff} if diff else {}),
    }


def sum_tags(files: Mapping[str, bytes]) -> dict[str, str]:
    """Returns the sums of those files that a run must not be gone on with where they are others, as its tags."""
    return {tag: sum_of(files[name]) for name, tag in SUM_TAGS.items()}


def volume_tags(prints: Fingerprints) -> dict[str, str]:
    """Returns the names of the volumes, each with the beginning of its fingerprint, as tags of a run."""
    told = {
        f"volumes.{part}": " ".join(f"{name}:{each[:N_PRINT_CHARS]}" for name, each in volumes.items())
        for part, volumes in prints.items()
    }
    return tags_of(told, whole_in=VOLUMES_FILE)


def place_tags(folder: Path) -> dict[str, str]:
    """Returns where a run is at work, and what with, as its tags."""
    return {"folder": str(folder.resolve()), "host": socket.gethostname(), VERSION_TAG: armscan.__version__}


def run_name(config: dict[str, Any], choices: dict[str, str]) -> str:
    """Returns what the UI calls a run: what most runs differ by."""
    projection = config["projection"]
    parts = [choices["agent"], choices["obs"], projection if isinstance(projection, str) else "+".join(projection)]
    parts += [
        f"{wrapper}{config[wrapper]}"
        for wrapper, without in (("stack", 1), ("memory", 0))
        if config[wrapper] != without
    ]
    return "-".join([*parts, choices["data"], f"seed{config['seed']}"])
