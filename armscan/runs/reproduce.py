"""Reproduction of a tracked run: differences from the original environment, and comparison of the results."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from armscan.config.command_hints import armscan_command
from armscan.config.defaults import CHOICES
from armscan.config.own_code import changed_modules
from armscan.errors import InvalidValueError, TrackingError, few
from armscan.evaluation.agent_source import from_its_folder
from armscan.experiment.build import RunSetup, set_up
from armscan.experiment.job import Invocation, remove_if_untracked
from armscan.experiment.provenance import start_tracking
from armscan.experiment.runner import run_tracked
from armscan.runs.compare import Comparison, compare_runs
from armscan.tracking import FoundRun, code_state, environment_tags, load_agent_run
from armscan.tracking.environment import CONSTRAINTS_SUM, REPORTED_PACKAGES, environment
from armscan.tracking.git import COMMIT, DIFF_SUM, DIRTY
from armscan.tracking.outbox import ENDED
from armscan.tracking.tags import CHOICE, OVERRIDES_TAG, OWN_CODE_TAG, RESUMED_TAG, UNKNOWN
from armscan.training import check_unchanged
from armscan.utils.run_files import DIFF_FILE, ENVIRONMENT_FILE, REPRODUCTION_FILE, folder_lock

# Tags of a reproduction: the original run, and whether all metrics are the same.
OF_TAG, SAME_TAG = "reproduction.of", "reproduction.is_same"
# Number of differing packages to name, of those whose versions seldom matter.
N_SHOWN = 8


@dataclass(frozen=True)
class Original:
    """A run that is to be reproduced.

    Args:
        run: Tracked run.
        config: Configuration that it was started with, with absolute paths of files.
        setup: Setup of a run that the configuration describes, on the volumes that the run was started with.
        environment: Versions that it was computed with; None if they were not kept.
    """

    run: FoundRun
    config: DictConfig = field(repr=False)
    setup: RunSetup = field(repr=False)
    environment: Mapping[str, Any] | None = field(repr=False)


def load_original(tracking: str, run_id: str, *, trust: bool = False) -> Original:
    """Return a tracked run, ready to be reproduced.

    Args:
        tracking: Address of the tracking store.
        run_id: MLflow run ID.
        trust: Whether its configuration may build any class. Default: False, only armscan's own.

    Raises:
        ArmscanError: If there is no such run, it was not made by `armscan run`, it has not ended, its files are missing
            or changed, or its volumes have changed since it was started.
    """
    run = load_agent_run(tracking, run_id)
    if run.status not in ENDED:
        raise InvalidValueError(f"run {run.run_id} has not ended ({run.status}): there is nothing to compare with yet")
    with tempfile.TemporaryDirectory() as folder:
        config = from_its_folder(OmegaConf.create(run.config(Path(folder), trust=trust)), run.tags)
        volumes = run.volumes(Path(folder))
        text = run.text(ENVIRONMENT_FILE, Path(folder))
    config.tracking.uri = tracking
    config.tracking.experiment = run.store.get_experiment(run.experiment_id).name
    setup = set_up(config)
    if volumes is not None:
        check_unchanged(volumes, setup.fingerprints, f"run {run.run_id} was started with")
    return Original(run, config, setup, None if text is None else _environment(text, run))


def _environment(text: str, run: FoundRun) -> Mapping[str, Any]:
    """Return the environment that a run has kept."""
    try:
        kept = json.loads(text)
        return dict(kept) | {"packages": dict(kept["packages"])}
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise TrackingError(f"run {run.run_id}: its {ENVIRONMENT_FILE} is damaged, or another file") from error


def differences(original: Original) -> list[str]:
    """Return the differences from the original environment of a run, in a line each: code, packages, machine."""
    tags, now = original.run.tags, {**code_state().tags, **environment_tags()}
    lines = [
        f"{what} was {tags.get(tag, 'not kept')}, and is {now.get(tag, 'not kept')}"
        for tag, what in ((COMMIT, "the git commit"), (CONSTRAINTS_SUM, "the SHA-256 of constraints.txt"))
        if tags.get(tag) != now.get(tag)
    ]
    if any(tags.get(tag) != now.get(tag) for tag in (DIFF_SUM, DIRTY)):
        kept = (
            f"; its {DIFF_FILE} is among its artifacts" if DIFF_SUM in tags and DIFF_FILE in original.run.files else ""
        )
        lines.append(f"changes since the commit {_changes(tags)}, and {_changes(now)} now{kept}")
    if modules := changed_modules(tags.get(OWN_CODE_TAG), original.setup.own_code):
        lines.append(f"the code of {few(modules)} has changed since")
    if RESUMED_TAG in tags:
        lines.append(f"the run was cut off and resumed (times: {tags[RESUMED_TAG]}), which changes no figure by itself")
    if original.environment is None:
        return [*lines, "the versions of its packages were not kept"]
    before, here = original.environment, environment()
    machine = [key for key in ("python", "platform", "machine") if before.get(key) != here[key]]
    lines += [f"{key} was {before.get(key)}, and is {here[key]}" for key in machine]
    # armscan's own version adds nothing to a commit.
    own = set() if UNKNOWN in (tags.get(COMMIT), now.get(COMMIT)) else {"armscan"}
    packages = sorted((before["packages"].keys() | here["packages"].keys()) - own)
    pairs = {name: [each["packages"].get(name, "not installed") for each in (before, here)] for name in packages}
    changed = {name: f"{name} was {then}, and is {now}" for name, (then, now) in pairs.items() if then != now}
    lines += [line for name, line in changed.items() if name in REPORTED_PACKAGES]
    if others := [name for name in changed if name not in REPORTED_PACKAGES]:
        lines.append(f"other packages whose versions differ, or that only one has: {few(others, N_SHOWN)}")
    return lines


def not_compared(original: Original) -> list[str]:
    """Return the parts of a run's code that cannot be compared with today's, in a line each."""
    lines = []
    if UNKNOWN in (original.run.tags.get(COMMIT), code_state().tags.get(COMMIT)):
        lines.append("the code of armscan, which did not run from a git repository then or does not now")
    if original.run.needs_trust and OWN_CODE_TAG not in original.run.tags:
        lines.append("the code of classes that are not armscan's, of which the run has no checksums")
    return lines


def _changes(tags: Mapping[str, str]) -> str:
    if DIFF_SUM in tags:
        return f"had the SHA-256 {tags[DIFF_SUM][:8]}"
    return {"false": "were none", "true": "were some"}.get(tags.get(DIRTY, ""), "were not kept")


def reproduce(original: Original, folder: Path, differing: Sequence[str]) -> Comparison:
    """Repeat a run, and compare the results.

    Args:
        original: Run to reproduce.
        folder: Folder of the new run; created if it does not exist.
        differing: Differences that `differences` found; kept with the new run.

    Returns:
        The comparison of all metrics, except those of time and machine.

    Raises:
        InvalidValueError: If the folder is not empty.
    """
    run = original.run
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InvalidValueError(f"--out is {str(folder)!r}, but it exists and is not an empty folder: name another")
    is_ours = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    choices = {group: run.tags.get(f"{CHOICE}{group}", UNKNOWN) for group in CHOICES}
    overrides = run.tags.get(OVERRIDES_TAG, "").split()
    uri = original.config.tracking.uri
    command = armscan_command("runs", "reproduce", run.run_id, tracking=uri, trust=original.setup.needs_trust)
    invocation = Invocation(folder, overrides, command, choices)
    try:
        with folder_lock(folder):
            tracked = start_tracking(original.config, invocation, original.setup, tags={OF_TAG: run.run_id})
            run_tracked(original.setup, tracked, folder, uri)
    except BaseException as error:
        if is_ours:
            remove_if_untracked(folder, error)
        raise
    comparison = compare_runs(run.store, run.run_id, tracked.run_id)
    facts = {"of": run.run_id, "run": tracked.run_id, "differences": list(differing), **comparison.to_dict()}
    (folder / REPRODUCTION_FILE).write_text(json.dumps(facts, indent=1))
    run.store.set_tag(tracked.run_id, SAME_TAG, str(comparison.is_same).lower())
    run.store.log_artifact(tracked.run_id, str(folder / REPRODUCTION_FILE))
    return comparison
