"""Delivers what is to be tracked of a run to its store, beside the training, which waits for nothing."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from mlflow import MlflowClient
from mlflow.entities import Metric, Param, RunTag
from mlflow.exceptions import MlflowException

from armscan.errors import TrackingError
from armscan.log import say
from armscan.patience import FIRST_PAUSE_S
from armscan.tracking.client import NOT_THERE, TrackingStore, reason_in, why_away
from armscan.tracking.spool import LANES, Lane, Spool

# MLflow takes no more of each in one request.
AT_ONCE = {"metrics": 1000, "params": 100, "tags": 100}
ENTRIES_AT_ONCE = 200
LONGEST_PAUSE_S, LOOK_S = 5.0, 0.5


class Courier:
    """A thread that delivers a run's entries as they are added.

    Args:
        spool: of the run.
        store: that it is in.
    """

    def __init__(self, spool: Spool, store: TrackingStore) -> None:
        self._spool, self._store = spool, store
        self._changing = threading.Lock()
        self._woken, self._stopped, self._is_done = threading.Event(), threading.Event(), threading.Event()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="courier", daemon=True)
        self._thread.start()

    @property
    def is_away(self) -> bool:
        """Whether the store cannot be reached, as far as is known, and does not refuse what it is given."""
        return self._failure is None or why_away(self._failure) is not None

    def wake(self) -> None:
        """Says that something was added."""
        with self._changing:
            self._is_done.clear()
            self._woken.set()

    def finish(self, wait_s: float) -> str | None:
        """Waits until everything is delivered, and ends the thread.

        Args:
            wait_s: at most, and not at all where the store refuses what it is given.

        Returns:
            Why not everything is delivered; None where it is.
        """
        until_s, is_told = time.monotonic() + wait_s, False
        while not self._is_done.wait(min(LOOK_S, max(0.0, until_s - time.monotonic()))):
            if not self.is_away or time.monotonic() > until_s:
                break
            if self._failure is not None and not is_told:
                is_told = True
                say(f"run {self._spool.address.run_id}: waiting up to {wait_s:g} s for {self._store.uri}")
        self._stopped.set()
        self._woken.set()
        # It ends by itself, unless it hangs in a request; this process does not wait for that.
        self._thread.join(0.5)
        if self._is_done.is_set():
            return None
        return "the store has not answered in time" if self._failure is None else reason_in(self._failure)

    def _work(self) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._stopped.is_set():
            self._woken.clear()
            failure = self._failed()
            self._tell(failure)
            if failure is not None:
                self._stopped.wait(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
                continue
            pause_s = FIRST_PAUSE_S
            with self._changing:
                if not self._woken.is_set():
                    self._is_done.set()
            self._woken.wait()

    def _failed(self) -> Exception | None:
        """Delivers what there is; returns what went wrong, of what did."""
        failure = None
        for lane in LANES:
            try:
                deliver(self._spool, self._store.mlflow, lane)
            # Whatever a store raises: what is to be tracked stays where it is, and the training goes on.
            except Exception as error:
                failure = error
        return failure

    def _tell(self, failure: Exception | None) -> None:
        """Says once that the store is away, or refuses something, and once that it is over."""
        before, self._failure = self._failure, failure
        if failure is not None and before is None:
            is_away = why_away(failure) is not None
            said = "cannot be reached or written to" if is_away else "refuses what it is given"
            say(f"{self._store.uri} {said} ({reason_in(failure)}): what is tracked is kept in {self._spool.file}")
        elif failure is None and before is not None:
            say(f"{self._store.uri} is back: everything is delivered")


def deliver(spool: Spool, client: MlflowClient, lane: Lane, *, is_whole: bool = True) -> int:
    """Delivers what is to be delivered in a lane of a spool.

    Args:
        spool: of a run.
        client: of its store.
        lane: which entries.
        is_whole: whether a file that is not there was removed, and not left behind when the folder was copied.

    Returns:
        How many there were.

    Raises:
        FileNotFoundError: if a file is not there that may be elsewhere.
    """
    n_delivered = 0
    while True:
        entries, end = spool.next_entries(lane, ENTRIES_AT_ONCE if lane == "figures" else 1)
        if not entries:
            return n_delivered
        for entry in entries if lane == "files" and not is_whole else ():
            if not (file := spool.folder / _file_of(entry["file"])[0]).exists():
                raise FileNotFoundError(f"{file} is not there")
        for kind, group in itertools.groupby(entries, key=lambda entry: next(iter(entry))):
            _deliver(client, spool, kind, [entry[kind] for entry in group])
        spool.mark(lane, end)
        n_delivered += len(entries)


def _deliver(client: MlflowClient, spool: Spool, kind: str, values: list[Any]) -> None:
    run_id = spool.address.run_id
    match kind:
        case "metrics":
            for batch in _batches(itertools.chain(*values), AT_ONCE[kind]):
                client.log_batch(run_id, metrics=[Metric(*point) for point in batch])
        case "params":
            for batch in _batches(itertools.chain(*(each.items() for each in values)), AT_ONCE[kind]):
                client.log_batch(run_id, params=[Param(*pair) for pair in batch])
        case "tags":
            for batch in _batches(itertools.chain(*(each.items() for each in values)), AT_ONCE[kind]):
                client.log_batch(run_id, tags=[RunTag(*pair) for pair in batch])
        case "untagged":
            for tag in values:
                _delete_tag(client, run_id, tag)
        case "status":
            for status, at_ms in values:
                _set_status(client, run_id, status, at_ms)
        case "file":
            for name, place in map(_file_of, values):
                _keep_file(client, run_id, spool.folder / name, place)
        case "address":
            return
        case _:
            raise TrackingError(f"{spool.file}: holds {kind!r}, which this version of armscan does not know")


def _batches(values: Iterable[Any], size: int) -> Iterable[Sequence[Any]]:
    rest = iter(values)
    while batch := list(itertools.islice(rest, size)):
        yield batch


def _delete_tag(client: MlflowClient, run_id: str, tag: str) -> None:
    try:
        client.delete_tag(run_id, tag)
    except MlflowException as error:
        if error.error_code != NOT_THERE:
            raise


def _set_status(client: MlflowClient, run_id: str, status: str, at_ms: int) -> None:
    if status == "RUNNING":
        client.update_run(run_id, status=status)
    else:
        client.set_terminated(run_id, status, end_time=at_ms)


def _file_of(value: str | list[str]) -> tuple[str, str | None]:
    """Returns the name of a file that is to be kept, and the folder among the artifacts that it goes to."""
    if isinstance(value, str):
        return value, None
    name, place = value
    return name, place


def _keep_file(client: MlflowClient, run_id: str, path: Path, place: str | None) -> None:
    if not path.exists():
        say(f"run {run_id}: {path} was removed before the store could keep it")
        return
    client.log_artifact(run_id, str(path), place)
