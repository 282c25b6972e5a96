"""Upload the entries of an outbox in the background, while the run trains."""

from __future__ import annotations

import contextlib
import itertools
import json
import threading
import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from armscan.config.trust import TRUST
from armscan.errors import TrackingError, UntrustedError
from armscan.tracking.logged_model import upload_model
from armscan.tracking.outbox import CHANNELS, Channel, Outbox, file_and_place
from armscan.tracking.sanitize import MAX_PARAM_CHARS, MAX_TAG_CHARS, metric_name_of, truncate
from armscan.tracking.tags import DESCRIPTION_TAG
from armscan.tracking.tracking_store import NOT_THERE, TrackingStore, reason_in, unavailable_reason
from armscan.utils.files import sha256
from armscan.utils.log import log
from armscan.utils.retry import pauses_s
from armscan.utils.run_files import RESULTS_PAGE, VOLUMES_FILE

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import DatasetInput

# By kind: the class in `mlflow.entities`, and how many MLflow accepts in one request.
AT_ONCE = {"metrics": ("Metric", 1000), "params": ("Param", 100), "tags": ("RunTag", 100)}
ENTRIES_AT_ONCE = 200
# Length of a dataset's digest; MLflow's limit is 36.
DIGEST_CHARS = 16
# SHA-256 of the description that armscan wrote: one with another checksum was written by a person.
DESCRIPTION_SUM_TAG = "note.sha256"
POLL_S = 0.5


class Uploader:
    """A thread that uploads a run's entries to its store as they are added to its outbox."""

    def __init__(self, outbox: Outbox, store: TrackingStore) -> None:
        self._outbox, self._store = outbox, store
        self._changing = threading.Lock()
        self._woken, self._stopped, self._is_done = threading.Event(), threading.Event(), threading.Event()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="uploader", daemon=True)
        self._thread.start()

    @property
    def is_unavailable(self) -> bool:
        """Whether the store is unavailable, as far as known, rather than refusing entries."""
        return self._failure is None or unavailable_reason(self._failure) is not None

    def wake(self) -> None:
        """Signal that an entry was added."""
        with self._changing:
            self._is_done.clear()
            self._woken.set()

    def finish(self, wait_s: float) -> str | None:
        """Wait until everything is uploaded, and end the thread.

        Args:
            wait_s: Longest wait in seconds without an upload; a store that refuses entries is not waited for.

        Returns:
            Why not everything is uploaded; None if it is.
        """
        until_s, n_uploaded, is_told = time.monotonic() + wait_s, self._outbox.n_uploaded_bytes, False
        while not self._is_done.wait(min(POLL_S, max(0.0, until_s - time.monotonic()))):
            if n_uploaded != (n_uploaded := self._outbox.n_uploaded_bytes):
                until_s = time.monotonic() + wait_s
            if not self.is_unavailable or time.monotonic() > until_s:
                break
            if self._failure is not None and not is_told:
                is_told = True
                log(f"run {self._outbox.address.run_id}: waiting up to {wait_s:g} s for {self._store.uri}")
        self._stopped.set()
        self._woken.set()
        # The thread may hang in a request, which this process does not wait for.
        self._thread.join(0.5)
        # Its folder may have been removed meanwhile.
        with contextlib.suppress(OSError, TrackingError):
            if self._is_done.is_set() or self._outbox.is_uploaded:
                return None
        return "the store has not answered in time" if self._failure is None else reason_in(self._failure)

    def _work(self) -> None:
        pauses = pauses_s()
        while not self._stopped.is_set():
            self._woken.clear()
            failure = self._failed()
            self._tell(failure)
            if failure is not None:
                self._stopped.wait(next(pauses))
                continue
            pauses = pauses_s()
            with self._changing:
                if not self._woken.is_set():
                    self._is_done.set()
            self._woken.wait()

    def _failed(self) -> Exception | None:
        """Upload all entries; return the last error."""
        failure = None
        for channel in CHANNELS:
            try:
                upload(self._outbox, self._store.mlflow, channel)
            # Any error of the store: the entries stay in the outbox, and the training goes on.
            except Exception as error:
                failure = TrackingError("the run's folder was removed") if self._outbox.is_removed else error
        return failure

    def _tell(self, failure: Exception | None) -> None:
        """Log once that the store is unavailable or refuses entries, and once that it is back."""
        before, self._failure = self._failure, failure
        if failure is not None and self._outbox.is_removed:
            if before is None:
                log(f"{self._outbox.folder} was removed: what is not uploaded yet is lost")
        elif failure is not None and before is None:
            is_unavailable = unavailable_reason(failure) is not None
            said = "cannot be reached or written to" if is_unavailable else "refuses entries"
            log(f"{self._store.uri} {said} ({reason_in(failure)}): entries are buffered in {self._outbox.file}")
        elif failure is None and before is not None:
            log(f"{self._store.uri} is back: everything is uploaded")


def upload(
    outbox: Outbox, client: MlflowClient, channel: Channel, *, is_whole: bool = True, trust: bool = False
) -> int:
    """Upload the pending entries of one channel.

    Args:
        outbox: Outbox of the run.
        client: Client of the run's store.
        channel: Channel whose entries are uploaded.
        is_whole: Whether the run's folder is complete, so that a missing file was removed on purpose. Default: True.
        trust: Whether to upload files outside of the run's folder that another process has added. Default: False.

    Returns:
        The number of entries.

    Raises:
        FileNotFoundError: If a file is missing, and the folder may be an incomplete copy.
        UntrustedError: If a file outside of the run's folder was added by another process, which may be untrusted.
    """
    n_uploaded = 0
    while True:
        entries, end = outbox.next_entries(channel, ENTRIES_AT_ONCE if channel == "figures" else 1)
        if not entries:
            return n_uploaded
        for entry in entries if channel == "files" else ():
            file = outbox.folder / (name := file_and_place(entry["file"])[0])
            if not trust and name not in outbox.added and not file.resolve().is_relative_to(outbox.folder.resolve()):
                raise UntrustedError(f"{file} is outside of the run's folder; if you trust its author, add {TRUST}")
            if not is_whole and not file.exists():
                raise FileNotFoundError(f"{file} is not there")
        for kind, group in itertools.groupby(entries, key=lambda entry: next(iter(entry))):
            _upload(client, outbox, kind, [entry[kind] for entry in group])
        outbox.mark(channel, end)
        n_uploaded += len(entries)


def dataset_input(part: str, fingerprints: Mapping[str, str]) -> DatasetInput:
    """Return volumes as an MLflow dataset, with a digest of their fingerprints.

    Args:
        part: Split of the volumes: `training`, `validation` or `test`.
        fingerprints: Fingerprint of each volume by its name.
    """
    from mlflow.entities import Dataset, DatasetInput, InputTag

    digest = sha256("".join(sorted(fingerprints.values())).encode())[:DIGEST_CHARS]
    profile = json.dumps({"volumes": len(fingerprints)})
    source = truncate(" ".join(fingerprints), MAX_PARAM_CHARS, VOLUMES_FILE)
    dataset = Dataset(f"{part} volumes", digest, "armscan", json.dumps({"volumes": source}), profile=profile)
    return DatasetInput(dataset, [InputTag("mlflow.data.context", part)])


def _upload(client: MlflowClient, outbox: Outbox, kind: str, values: list[Any]) -> None:
    from mlflow import entities
    from mlflow.exceptions import MlflowException

    run_id = outbox.address.run_id
    match kind:
        case "metrics" | "params" | "tags":
            name, at_once = AT_ONCE[kind]
            entity = getattr(entities, name)
            of_all = (each.items() if isinstance(each, dict) else each for each in values)
            rest: Iterator[Any] = itertools.chain.from_iterable(of_all)
            if kind == "metrics":
                # Volumes, and with them their metrics, may have any name.
                rest = ((metric_name_of(key), *point) for key, *point in rest)
            while batch := [entity(*each) for each in itertools.islice(rest, at_once)]:
                request: dict[str, Any] = {kind: batch}
                client.log_batch(run_id, **request)
        case "untagged":
            for tag in values:
                try:
                    client.delete_tag(run_id, tag)
                except MlflowException as error:
                    if error.error_code != NOT_THERE:
                        raise
        case "status":
            for status, at_ms in values:
                if status == "RUNNING":
                    client.update_run(run_id, status=status)
                else:
                    client.set_terminated(run_id, status, end_time=at_ms)
        case "file":
            for name, place in map(file_and_place, values):
                if (file := outbox.folder / name).exists():
                    client.log_artifact(run_id, str(file), place)
                else:
                    log(f"run {run_id}: {file} was removed before the store could keep it")
        case "datasets":
            for datasets in values:
                client.log_inputs(run_id, [dataset_input(*each) for each in datasets])
        case "model":
            for step, metrics in values:
                upload_model(client, run_id, step, metrics)
        case "note":
            set_description(client, run_id, values[-1])
        case "address":
            return
        case _:
            raise TrackingError(f"{outbox.file}: holds {kind!r}, which this version of armscan does not know")


def set_description(client: MlflowClient | TrackingStore, run_id: str, text: str) -> None:
    """Set the description of a run, unless a person has written one."""
    from mlflow.entities import RunTag

    text = truncate(text, MAX_TAG_CHARS, RESULTS_PAGE)
    tags = client.get_run(run_id).data.tags
    if DESCRIPTION_TAG not in tags or sha256(tags[DESCRIPTION_TAG].encode()) == tags.get(DESCRIPTION_SUM_TAG):
        # In one request: a description without its checksum would look like a person's.
        client.log_batch(
            run_id, tags=[RunTag(DESCRIPTION_TAG, text), RunTag(DESCRIPTION_SUM_TAG, sha256(text.encode()))]
        )
