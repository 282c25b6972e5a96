"""`armscan run resume=ID`: resume a run, or complete a grid."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hydra.core.override_parser.overrides_parser import OverridesParser
from pydantic import TypeAdapter, ValidationError

from armscan.config.defaults import RESUME, TRACKING_URI, default_tracking
from armscan.config.trust import TRUST, check_stored_overrides
from armscan.errors import InvalidValueError, ResumeError, UntrustedError
from armscan.experiment.resume import check_unfinished, enter_working_folder, resume_run, tag_of
from armscan.tracking import check_run_id, find_run, open_existing_store
from armscan.tracking.pending_runs import PendingRun
from armscan.tracking.tags import GRID_TAG, WORKING_FOLDER_TAG
from armscan.utils.files import SQLITE_PREFIX, sqlite_file

if TYPE_CHECKING:
    from mlflow.entities import Run


class GridToRepeat(NamedTuple):
    """A grid whose unfinished jobs are run.

    Args:
        overrides: Overrides that repeat it.
        run_id: MLflow run ID of its parent run.
        trust: Whether its jobs may build any class.
    """

    overrides: list[str]
    run_id: str
    trust: bool


def resume(arguments: Sequence[str]) -> GridToRepeat | None:
    """Resume the run that a command line names; return it if it is a grid, which is repeated.

    Args:
        arguments: Arguments of the command line.

    Raises:
        InvalidValueError: If they say anything else.
        UntrustedError: If it would execute code of others, and there is no `--trust`.
        ArmscanError: If there is no such run, it is still running, or its checkpoint or volumes are not its own.
    """
    trust = TRUST in arguments
    wanted, uri = _read([each for each in arguments if each != TRUST])
    check_run_id(wanted)
    store = open_existing_store(uri)
    run = find_run(store, wanted)
    if GRID_TAG not in run.data.tags:
        resume_run(store, run.info.run_id, trust=trust)
        return None
    check_unfinished(run)
    _check_ended(run)
    overrides = _overrides_of(run)
    if not trust:
        _check_trust(run, overrides, uri)
    enter_working_folder(run, trust=trust)
    _check_store(run, overrides, store.uri)
    return GridToRepeat(overrides, run.info.run_id, trust)


def _read(overrides: Sequence[str]) -> tuple[str, str]:
    """Return the wanted run and the store to look in."""
    values = {TRACKING_URI: default_tracking()["uri"]}
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or key not in (RESUME, TRACKING_URI):
            raise InvalidValueError(
                f"{override!r} cannot be combined with {RESUME}=, because a run keeps its original configuration: "
                f"only {TRACKING_URI}= and {TRUST} may be added"
            )
        if key in values and key == RESUME and values[key] != text:
            raise InvalidValueError(f"{RESUME} names {values[key]!r} and {text!r}, but one run is resumed at a time")
        values[key] = text
    return values[RESUME], values[TRACKING_URI]


def _check_ended(run: Run) -> None:
    """Raise `ResumeError` if a grid's launcher is alive on this machine: its jobs would be taken from it."""
    launcher = pending.process if (pending := PendingRun.of(run.info.run_id)) is not None else None
    if run.info.status == "RUNNING" and launcher is not None and launcher.is_here and launcher.is_alive:
        raise ResumeError(
            f"run {run.info.run_id} is still running, in process {launcher.pid}: wait until it ends, or interrupt it"
        )


def _overrides_of(run: Run) -> list[str]:
    """Return the overrides that repeat a grid."""
    try:
        return TypeAdapter(list[str]).validate_json(tag_of(run, GRID_TAG), strict=True)
    except ValidationError as error:
        raise ResumeError(f"run {run.info.run_id}: its tag {GRID_TAG} holds no overrides") from error


def _check_trust(run: Run, overrides: Sequence[str], uri: str) -> None:
    """Raise `UntrustedError` if a grid's command line, or its working folder, is untrusted."""
    where = f"run {run.info.run_id}"
    check_stored_overrides(overrides, uri, where=where)
    # Its `conf/` and `sweeps/` are part of the configuration.
    folder = Path(tag_of(run, WORKING_FOLDER_TAG))
    if folder.resolve() != Path.cwd().resolve():
        raise UntrustedError(
            f"{where}: it was started in {folder}, whose configuration could execute code of others; repeat the "
            f"command there or, if you trust its author, with {TRUST}"
        )


def _check_store(run: Run, overrides: Sequence[str], uri: str) -> None:
    """Raise `ResumeError` if the jobs of a grid would be tracked in another store than the one that it was read from.

    To be called in the grid's working folder, where a relative address of its store begins.
    """
    parsed = OverridesParser.create().parse_overrides([*overrides])
    given = [each for each in parsed if each.key_or_group == TRACKING_URI]
    stored = str(given[-1].value()) if given else uri
    places = [
        str(Path(sqlite_file(each)).resolve()) if each.startswith(SQLITE_PREFIX) else each.rstrip("/")
        for each in (stored, uri)
    ]
    if places[0] != places[1]:
        raise ResumeError(
            f"run {run.info.run_id} was tracked in {stored}, where its jobs would be tracked again, and not in {uri}: "
            "put the store back under its old address, or start the grid again"
        )
