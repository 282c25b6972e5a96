"""Provenance of a run: configuration, volumes, code, packages, command, kept from its start."""

from __future__ import annotations

import json
import shutil
import socket
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig

import armscan
from armscan.config.defaults import CHOICES, to_plain
from armscan.config.own_code import as_tag
from armscan.experiment.build import RunSetup
from armscan.experiment.job import Invocation
from armscan.tracking import (
    TrackedRun,
    code_state,
    environment_file,
    environment_tags,
    open_store,
    tags_of,
    upload_pending,
)
from armscan.tracking.tags import (
    CHOICE,
    COMMAND_TAG,
    DOMAIN_TAG,
    FOLDER_TAG,
    HOST_TAG,
    JOB_TAG,
    OVERRIDES_TAG,
    OWN_CODE_TAG,
    SUBJECTS,
    VERSION_TAG,
    VOLUMES,
    WORKING_FOLDER_TAG,
)
from armscan.training import TrainingDomain
from armscan.utils.files import atomic_write, sha256
from armscan.utils.run_files import (
    CONFIG_FILE,
    DIFF_FILE,
    ENVIRONMENT_FILE,
    POLICY_FOLDER,
    REPRODUCTION_FILE,
    RESULTS,
    RESUMED_DIFF_FILE,
    SHA256_TAGS,
    VOLUMES_FILE,
)

# Length of a volume's fingerprint in a tag; `volumes.json` has the whole.
N_PRINT_CHARS = 16


def start_tracking(
    config: DictConfig,
    invocation: Invocation,
    setup: RunSetup,
    *,
    parent_id: str | None = None,
    tags: Mapping[str, str] | None = None,
    retry_s: float | None = None,
) -> TrackedRun:
    """Write the provenance files, open the tracking store and start a run in it.

    Files of an earlier run in the folder are replaced; `check_free` has checked that they are a run's.

    Args:
        config: Composed configuration.
        invocation: Command line, overrides and folder of the run.
        setup: Objects built from the configuration.
        parent_id: MLflow run ID of its parent run. Default: None, a run of its own.
        tags: Further tags of the run. Default: none.
        retry_s: Seconds to wait for an unavailable store. Default: None, no waiting.
    """
    resolved = to_plain(config)
    store, experiment_id = open_store(**resolved["tracking"], retry_s=retry_s)
    upload_pending(store)
    choices, job = _with_own_observation(invocation.choices, resolved), invocation.job
    files = provenance_files(resolved, setup)
    _remove_earlier(invocation.folder)
    # Before the run exists, so that it can be resumed whenever it is killed.
    for name, contents in files.items():
        atomic_write(invocation.folder / name, contents)
    started = TrackedRun.start(
        store,
        experiment_id,
        name=run_name(resolved, choices),
        config=resolved,
        tags={
            **environment_tags(),
            COMMAND_TAG: invocation.command,
            "seed": str(resolved["seed"]),
            OVERRIDES_TAG: " ".join(invocation.overrides),
            **{f"{CHOICE}{group}": choices[group] for group in CHOICES},
            **volume_tags(setup),
            # On other volumes, an evaluation must reproduce the agent's observations.
            DOMAIN_TAG: TrainingDomain.of(setup.training_env, setup.smallest_slice_px).to_json(),
            **place_tags(invocation.folder),
            WORKING_FOLDER_TAG: str(Path.cwd()),
            **sha256_tags(files),
            **({OWN_CODE_TAG: as_tag(setup.own_code)} if setup.own_code else {}),
            **({JOB_TAG: str(job.number)} if job else {}),
            **(tags or {}),
        },
        folder=invocation.folder,
        parent_id=parent_id,
    )
    with ExitStack() as stack:
        tracked = stack.enter_context(started)
        tracked.log_datasets(setup.fingerprints)
        tracked.log_files(*(invocation.folder / name for name in files))
        # It stays open, unless it was interrupted.
        stack.pop_all()
    return tracked


def _remove_earlier(folder: Path) -> None:
    """Remove what an earlier run has left in a folder, and would be taken for the new run's."""
    names = (*RESULTS, DIFF_FILE, REPRODUCTION_FILE)
    for stale in (*(folder / name for name in names), *folder.glob(RESUMED_DIFF_FILE.format("*"))):
        stale.unlink(missing_ok=True)
    # A link is not followed.
    shutil.rmtree(folder / POLICY_FOLDER, ignore_errors=True)


def provenance_files(config: dict[str, Any], setup: RunSetup) -> dict[str, bytes]:
    """Return the files that describe a run's origin, by their names: configuration, volumes, packages, code."""
    diff = code_state().diff
    return {
        CONFIG_FILE: yaml.safe_dump(config, sort_keys=False).encode(),
        VOLUMES_FILE: json.dumps(setup.fingerprints, indent=1).encode(),
        ENVIRONMENT_FILE: environment_file(),
        **({DIFF_FILE: diff} if diff else {}),
    }


def sha256_tags(files: Mapping[str, bytes]) -> dict[str, str]:
    """Return the checksums of the files that must be unchanged when a run is resumed, as its tags."""
    return {tag: sha256(files[name]) for name, tag in SHA256_TAGS.items()}


def volume_tags(setup: RunSetup) -> dict[str, str]:
    """Return the names of the volumes, each with the beginning of its fingerprint, and subjects as tags of a run."""
    names = {
        f"{VOLUMES}{part}": " ".join(f"{name}:{each[:N_PRINT_CHARS]}" for name, each in volumes.items())
        for part, volumes in setup.fingerprints.items()
    }
    subjects = {
        f"{SUBJECTS}{part}": "\n".join(dict.fromkeys(volume.subject for volume in volumes.values() if volume.subject))
        for part, volumes in setup.split.parts.items()
    }
    subjects = {tag: value for tag, value in subjects.items() if value}
    return tags_of(names, whole_in=VOLUMES_FILE) | tags_of(subjects, whole_in="the manifest")


def place_tags(folder: Path) -> dict[str, str]:
    """Return folder, host and version of a run as its tags."""
    return {FOLDER_TAG: str(folder.resolve()), HOST_TAG: socket.gethostname(), VERSION_TAG: armscan.__version__}


def _with_own_observation(choices: Mapping[str, str], config: Mapping[str, Any]) -> dict[str, str]:
    """Return the choices of a run, with the observation that `env.observation` names in place of `obs`."""
    observation = config["env"]["observation"]
    if observation == config["obs"]:
        return dict(choices)
    names = [
        str(each.get("_target_", each)).rpartition(".")[2] if isinstance(each, Mapping) else str(each)
        for each in (observation if isinstance(observation, list) else [observation])
    ]
    return {**choices, "obs": "+".join(names)}


def run_name(config: dict[str, Any], choices: dict[str, str]) -> str:
    """Return the name of a run in the UI: the choices by which most runs differ."""
    rules = config["env"]
    projection = rules["projection"]
    parts = [choices["agent"], choices["obs"], projection if isinstance(projection, str) else "+".join(projection)]
    parts += [f"{name}{rules[name]}" for name, without in (("stack", 1), ("memory", 0)) if rules[name] != without]
    # By another reward, success is something else.
    parts += [choices["reward"]] * (choices["reward"] != "published")
    fold = config["data"].get("fold")
    return "-".join([*parts, choices["data"], *([] if fold is None else [f"fold{fold}"]), f"seed{config['seed']}"])
