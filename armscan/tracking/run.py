"""One tracked run: parameters, learning curves, evaluations and artifacts in MLflow."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from armscan.config.command_hints import armscan_command
from armscan.errors import TrackingError, is_interruption
from armscan.tracking.environment import environment_tags
from armscan.tracking.git import DIFF_SUM, code_state
from armscan.tracking.outbox import Address, Outbox, file_of, now_ms
from armscan.tracking.pending_runs import forget
from armscan.tracking.sanitize import params_of, tags_of
from armscan.tracking.system_metrics import PREFIX, SystemMetrics
from armscan.tracking.tags import FAILURE_TAG, PARENT_TAG, PRUNED_TAG, RESUMED_TAG, VALIDATION_PREFIX
from armscan.tracking.tracking_store import TrackingStore
from armscan.tracking.uploader import Uploader
from armscan.utils.files import atomic_write
from armscan.utils.log import log
from armscan.utils.run_files import RESULTS, RESUMED_DIFF_FILE

if TYPE_CHECKING:
    from mlflow.entities import Run

    from armscan.training import EpochReport

MODEL_FILE = "MLmodel"
# Suffix of the name of a run whose trial was pruned.
PRUNED = " (pruned)"
# No run of armscan has this many ancestors; in an untrusted store, a run may be its own ancestor.
MAX_DEPTH = 8
MAX_REASON_CHARS, MAX_DIGITS = 5000, 9
# Wait for an unavailable store while somebody waits for this process to end.
SHORT_WAIT_S = 2.0


class TrackedRun:
    """A run in MLflow, and the training callback that logs to it.

    Everything logged goes to the run's outbox and is uploaded in the background, so training never waits for the store.
    `armscan runs sync FOLDER` uploads what is left if the store was unavailable.

    Args:
        store: Store of the run.
        outbox: Outbox of the run.
        name: Name of the run in the UI.
        logged: Names and steps of metrics that an earlier process logged, which are not logged again. Default: none.
    """

    def __init__(
        self, store: TrackingStore, outbox: Outbox, *, name: str, logged: Collection[tuple[str, int]] = ()
    ) -> None:
        self._store, self._outbox = store, outbox
        outbox.mark_pending(store.uri)
        self._uploader = Uploader(outbox, store)
        self._logged = frozenset(logged)
        self._is_closed, self._is_uploaded, self._is_resumed = False, False, False
        self._system: SystemMetrics | None = None
        self.run_id = outbox.address.run_id
        self.name = name

    @classmethod
    def start(
        cls,
        store: TrackingStore,
        experiment_id: str,
        *,
        name: str,
        config: Mapping[str, Any],
        tags: Mapping[str, str],
        folder: Path,
        parent_id: str | None = None,
    ) -> Self:
        """Create a run.

        Args:
            store: Store of the run.
            experiment_id: ID of its MLflow experiment.
            name: Name of the run in the UI.
            config: Resolved configuration, whose leaves become parameters.
            tags: Tags of the run, beside those of the source code.
            folder: Folder of the run.
            parent_id: ID of its parent run. Default: None, no parent.
        """
        parent = {PARENT_TAG: parent_id} if parent_id else {}
        run = store.create_run(experiment_id, name=name, tags={**code_state().tags, **tags, **parent})
        tracked = cls.open_existing(store, run.info.run_id, name=name, folder=folder)
        with ExitStack() as stack:
            stack.enter_context(tracked)
            tracked._log_config(config)
            # It stays open, unless it was interrupted.
            stack.pop_all()
        return tracked

    @classmethod
    def open_existing(cls, store: TrackingStore, run_id: str, *, name: str, folder: Path) -> Self:
        """Open an existing run to add to it."""
        return cls(store, Outbox.begin(folder, Address(run_id, store.uri)), name=name)

    @classmethod
    def reopen(
        cls, store: TrackingStore, run: Run, *, folder: Path, config: Mapping[str, Any], tags: Mapping[str, str]
    ) -> Self:
        """Reopen an interrupted run.

        Args:
            store: Store of the run.
            run: Run to reopen.
            folder: Folder of the run.
            config: Resolved configuration; the parameters that the run lacks are logged.
            tags: Tags to set.

        Raises:
            TrackingError: If its tag `resumed` is not a whole number.
        """
        run_id = run.info.run_id
        store.check_artifacts_of(run)
        if not (resumed := run.data.tags.get(RESUMED_TAG, "0")).isdecimal():
            raise TrackingError(f"run {run_id}: its tag resumed is {resumed[:50]!r}, but it must be a whole number")
        n_resumed = int(resumed[:MAX_DIGITS]) + 1
        now = {**code_state().tags, **environment_tags()}
        changed = {f"{RESUMED_TAG}.{key}": value for key, value in now.items() if run.data.tags.get(key) != value}
        had_outbox = file_of(folder, run_id).exists()
        outbox = Outbox.begin(folder, Address(run_id, store.uri))
        entries = list(outbox.entries())
        params = set(run.data.params).union(*(entry.get("params", ()) for entry in entries))
        if had_outbox:
            logged = {(name, step) for entry in entries for name, _, _, step in entry.get("metrics", ())}
        else:
            # An earlier version made the run, without an outbox.
            histories = {name: store.get_metric_history(run_id, name) for name in run.data.metrics}
            logged = {(name, point.step) for name, points in histories.items() for point in points}
        tracked = cls(store, outbox, name=run.info.run_name or run_id, logged=logged)
        tracked.resume()
        tracked.set_tags(dict(tags) | changed | {RESUMED_TAG: str(n_resumed)})
        tracked._log_config(config, known=params)
        if (diff := code_state().diff) and f"{RESUMED_TAG}.{DIFF_SUM}" in changed:
            file = folder / RESUMED_DIFF_FILE.format(n_resumed)
            atomic_write(file, diff)
            tracked.log_files(file)
        return tracked

    def set_tags(self, tags: Mapping[str, str]) -> None:
        """Set tags."""
        if tags:
            self._add(tags=tags_of(tags))

    def set_pruned(self) -> None:
        """Mark the run's trial as pruned, with a tag and in the run's name."""
        self.set_tags({PRUNED_TAG: "true", "mlflow.runName": f"{self.name.removesuffix(PRUNED)}{PRUNED}"})

    def log_datasets(self, fingerprints: Mapping[str, Mapping[str, str]]) -> None:
        """Log the volumes as datasets of the run.

        Args:
            fingerprints: Fingerprints of the volumes, by split (training, validation, test) and name.
        """
        self._add(datasets=[[part, volumes] for part, volumes in fingerprints.items() if volumes])

    def _log_config(self, config: Mapping[str, Any], known: Collection[str] = ()) -> None:
        # MLflow refuses to change a parameter, such as the device.
        if params := {name: value for name, value in params_of(config).items() if name not in known}:
            self._add(params=params)

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Log the metrics that are missing because the run was killed, and start monitoring the machine."""
        for report in earlier:
            self.on_epoch(report)
        if (every_s := self._store.system_metrics_s) is not None:
            looks = [step for name, step in self._logged if name.startswith(PREFIX)]
            self._system = SystemMetrics(
                lambda metrics, number: self.log_metrics(metrics, n_env_steps=number),
                every_s=every_s,
                first=max(looks, default=-1) + 1,
            )

    def on_epoch(self, report: EpochReport) -> None:
        """Log an epoch's metrics at its environment step."""
        metrics = {f"{VALIDATION_PREFIX}{name}": value for name, value in report.evaluation.metrics().items()}
        metrics |= report.metrics | {"wall_s": report.wall_s}
        self.log_metrics(metrics, n_env_steps=report.n_env_steps)

    def on_end(self) -> None:
        """Stop monitoring the machine; evaluation and artifacts follow."""
        if self._system is not None:
            self._system.finish()
            self._system = None

    def log_metrics(self, metrics: Mapping[str, float], *, n_env_steps: int, keeps_nan: bool = False) -> None:
        """Log metrics at an environment step, except NaN and those that an earlier process logged.

        Args:
            metrics: Metrics by name.
            n_env_steps: The environment step.
            keeps_nan: Whether to log NaN, too, in place of values that are not valid any more. Default: False.
        """
        at_ms = now_ms()
        points = [
            (name, float(value), at_ms, n_env_steps)
            for name, value in metrics.items()
            # NaN is the mean over no episodes.
            if (keeps_nan or value == value) and (name, n_env_steps) not in self._logged
        ]
        if points:
            self._add(metrics=points)

    def log_model(self, metrics: Mapping[str, Sequence[str]], *, n_env_steps: int) -> None:
        """Log the best checkpoint as an MLflow model, with these metrics of the run.

        Args:
            metrics: Names of metrics, by the split (training, validation, test) that they were measured on.
            n_env_steps: Environment step of the checkpoint, at which they were logged.
        """
        self._add(model=[n_env_steps, {part: list(names) for part, names in metrics.items()}])

    def set_description(self, text: str) -> None:
        """Set the run's description in Markdown, shown at the top of its MLflow page, unless a person wrote one."""
        self._add(note=text)

    def log_files(self, *files: Path) -> None:
        """Upload files as artifacts; they must not change until the run has ended."""
        for file in files:
            self._add(file=os.path.relpath(file, self._outbox.folder))

    def log_folder(self, folder: Path) -> None:
        """Upload a folder with all its files, under its own name; it must not change until the run has ended."""
        files = [file for file in folder.rglob("*") if file.is_file()]
        # `MLmodel`, which marks a folder as a model, is uploaded last: then the other files are there.
        for file in sorted(files, key=lambda file: (file.name == MODEL_FILE, file)):
            name, place = os.path.relpath(file, self._outbox.folder), file.parent.relative_to(folder.parent)
            self._add(file=[name, place.as_posix()])

    def log_results(self, folder: Path) -> None:
        """Upload the files that the run has made in its folder, and no others."""
        self.log_files(*(folder / name for name in RESULTS if (folder / name).is_file()))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the run: FINISHED, KILLED if it was interrupted, FAILED after any other error."""
        if error is None:
            self.end("FINISHED")
            return
        try:
            if is_interruption(error):
                self.end("KILLED", reason="interrupted", wait_s=SHORT_WAIT_S)
            else:
                self.end("FAILED", reason=repr(error))
        # A full disk may have ended the run: report that error; the next start closes the run.
        except OSError as failure:
            log(f"run {self.run_id}: its end is not noted ({failure.strerror})")

    @property
    def is_finished(self) -> bool:
        """Whether the run has ended as FINISHED, uploaded or not."""
        return self._outbox.status == "FINISHED"

    def resume(self) -> None:
        """Mark the run as RUNNING again, even if it was closed after its last process died."""
        self._is_resumed = True
        self._add(status=("RUNNING", now_ms()))
        self._add(untagged=FAILURE_TAG)

    def end_requeued(self) -> None:
        """Close the run of a trial that is requeued, for another worker to resume."""
        self.end("KILLED", reason="requeued", wait_s=SHORT_WAIT_S)

    def end(self, status: str, *, reason: str | None = None, wait_s: float | None = None) -> bool:
        """Close the run, and wait until everything is uploaded.

        Args:
            status: Status: FINISHED, FAILED or KILLED.
            reason: Why the run failed or was interrupted. Default: None, no reason is recorded.
            wait_s: Seconds to wait for an unavailable store. Default: None, `wait_s` of the store.

        Returns:
            Whether everything is uploaded; the rest stays in the run's folder.

        Raises:
            TrackingError: If a finished run's folder was removed before everything was uploaded; the run has failed.
        """
        if self._is_closed:
            return self._is_uploaded
        self._is_closed = True
        if reason is not None:
            self._add(tags={FAILURE_TAG: reason[:MAX_REASON_CHARS]})
        elif self._is_resumed:
            # Another process that took the earlier one for dead may have set it since.
            self._add(untagged=FAILURE_TAG)
        self._add(status=(status, now_ms()))
        failure = self._uploader.finish(self._store.wait_s if wait_s is None else wait_s)
        self._is_uploaded = failure is None
        if self._is_uploaded:
            forget(self.run_id)
        self._outbox.close()
        if failure is not None and self._outbox.is_removed:
            self._fail_without_folder(status)
        elif failure is not None:
            again = armscan_command("runs", "sync", str(self._outbox.folder))
            how = "uploads the rest" if self._uploader.is_unavailable else "uploads the rest once the store takes it"
            log(f"run {self.run_id}: {self._store.uri} did not receive everything ({failure}): {again} {how}")
        return self._is_uploaded

    def _fail_without_folder(self, status: str) -> None:
        """Mark the run as failed in its store, because what was not uploaded is lost."""
        reason = f"its folder {self._outbox.folder} was removed before everything was uploaded"
        self._store.set_tag(self.run_id, FAILURE_TAG, reason[:MAX_REASON_CHARS])
        self._store.set_terminated(self.run_id, "FAILED")
        forget(self.run_id)
        if status == "FINISHED":
            raise TrackingError(f"run {self.run_id} has failed: {reason}")

    def _add(self, **entry: Any) -> None:
        self._outbox.add(**entry)
        self._uploader.wake()
