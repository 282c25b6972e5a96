"""Find a run in the store by its ID or its first characters; read its configuration and checkpoint."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from packaging.version import InvalidVersion, Version

import armscan
from armscan.config.trust import needs_trust, stored_config
from armscan.errors import InvalidValueError, TrackingError, TrackingUnavailableError, few, listed
from armscan.tracking.store import open_existing_store, store_errors
from armscan.tracking.tags import EVALUATED_TAG, VERSION_TAG
from armscan.tracking.tracking_store import TrackingStore, all_pages
from armscan.utils.run_files import BEST_CHECKPOINT, CONFIG_FILE, SHA256_TAGS, VOLUMES_FILE, is_as_tagged
from armscan.utils.strict_yaml import load_yaml

if TYPE_CHECKING:
    from mlflow.entities import Run

    from armscan.training import Fingerprints

ID = re.compile(r"[0-9a-f]{1,32}")
N_SHOWN = 4


@dataclass(frozen=True)
class FoundRun:
    """A run in the store.

    Args:
        store: Store of the run.
        uri: MLflow tracking URI, as the user typed it.
        experiment_id: MLflow experiment ID.
        run_id: MLflow run ID.
        name: Name of the run in the UI.
        status: Status of the run, such as RUNNING or FINISHED.
        tags: Tags of the run.
        files: Paths of its artifacts.
        needs_trust: Whether its configuration, judging by its parameters, can only be read with `--trust`.
    """

    store: TrackingStore = field(repr=False)
    uri: str
    experiment_id: str
    run_id: str
    name: str
    status: str
    tags: dict[str, str] = field(repr=False)
    files: tuple[str, ...]
    needs_trust: bool

    def config(self, folder: Path, *, trust: bool = False) -> dict[str, Any]:
        """Return the run's resolved configuration, with the keys of this version.

        Args:
            folder: Folder to download the file to.
            trust: Whether it may name classes that are not armscan's. Default: False.

        Raises:
            UntrustedError: If it is not trusted, and names other classes or holds an interpolation.
            TrackingError: If it is missing, damaged, or not the one that the run was started with.
        """
        try:
            config = dict(load_yaml(self._started_with(CONFIG_FILE, folder)))
        except (yaml.YAMLError, TypeError, ValueError) as error:
            raise TrackingError(f"run {self.run_id}: its {CONFIG_FILE} is damaged") from error
        return stored_config(config, where=f"run {self.run_id}", trust=trust)

    def checkpoint(self, folder: Path) -> Path | None:
        """Download the best checkpoint to `folder` and return its path; None if the run has none."""
        return self._fetched(BEST_CHECKPOINT, folder) if BEST_CHECKPOINT in self.files else None

    def volumes(self, folder: Path) -> Fingerprints | None:
        """Return the fingerprints of the run's volumes; None if an earlier version made the run, without them."""
        if SHA256_TAGS[VOLUMES_FILE] not in self.tags:
            return None
        # Deferred: a mistake on the command line is reported before it is loaded.
        from armscan.training import fingerprints_in

        return fingerprints_in(self._started_with(VOLUMES_FILE, folder), f"run {self.run_id}: its {VOLUMES_FILE}")

    def text(self, file: str, folder: Path) -> str | None:
        """Download a text artifact to `folder` and return its contents; None if the run has no such artifact."""
        return self._fetched(file, folder).read_text(errors="replace") if file in self.files else None

    def _started_with(self, file: str, folder: Path) -> bytes:
        if file not in self.files:
            raise TrackingError(
                f"run {self.run_id} has no {file} among its artifacts, as each run of armscan run has from its start: "
                "it was removed, or this is something else"
            )
        contents = self._fetched(file, folder).read_bytes()
        if not is_as_tagged(file, contents, self.tags):
            raise TrackingError(
                f"run {self.run_id}: its {file} is not the one that it was started with: changed, or another run's"
            )
        return contents

    def _fetched(self, file: str, folder: Path) -> Path:
        with store_errors(self.uri):
            return Path(self.store.download_artifacts(self.run_id, file, str(folder)))


def load_run(uri: str, run_id: str) -> FoundRun:
    """Return the run with an MLflow run ID, or with these first characters of it, and its files.

    Raises:
        TrackingError: If no run or several runs match, the run has runs below it or is a newer version's, or the
            store does not exist or cannot be used.
    """
    check_run_id(run_id)
    store = open_existing_store(uri)
    with store_errors(uri):
        run = find_run(store, run_id)
        check_version(run)
        children = store.children(run.info.experiment_id, run.info.run_id)
        if jobs := [child.info.run_id for child in children if EVALUATED_TAG not in child.data.tags]:
            raise TrackingError(f"run {run.info.run_id} has runs below it: give one of them, {few(jobs)}")
        return FoundRun(
            store=store,
            uri=uri,
            experiment_id=run.info.experiment_id,
            run_id=run.info.run_id,
            name=run.info.run_name,
            status=run.info.status,
            tags=dict(run.data.tags),
            files=tuple(artifact.path for artifact in store.list_artifacts(run.info.run_id)),
            needs_trust=needs_trust(run.data.params),
        )


def find_run(store: TrackingStore, run_id: str) -> Run:
    """Return the run with an MLflow run ID, or with these first characters of it, in any experiment of a store.

    Raises:
        TrackingError: If no run or several runs match.
    """
    check_run_id(run_id)
    experiments = all_pages(store.search_experiments)
    found = store.search_runs(
        [experiment.experiment_id for experiment in experiments],
        filter_string=f"attributes.run_id LIKE '{run_id}%'",
        max_results=N_SHOWN + 1,
    )
    if not found:
        raise TrackingError(f"the run is {run_id!r}, but no run of {store.uri} has an ID that begins with it")
    if len(found) > 1:
        ids = [run.info.run_id for run in found[:N_SHOWN]] + (["others"] if len(found) > N_SHOWN else [])
        raise TrackingError(f"the run is {run_id!r}, but that may be {listed(ids)}: give more of the ID")
    run: Run = found[0]
    return run


def run_of_study(
    store: TrackingStore, run_id: str, *, experiment_id: str, tags: Mapping[str, str | None], where: str
) -> Run:
    """Return a run that a study's storage names, once checked: an untrusted storage may name any run.

    Args:
        store: Tracking store.
        run_id: MLflow run ID.
        experiment_id: MLflow experiment of the study.
        tags: Required values of the run's tags, which show that it belongs to the study; None for a tag that it must
            not have.
        where: Attribute that names the run, such as `a.user_attrs.mlflow_run`, for the error.

    Raises:
        TrackingError: If the run does not belong to the study, or is not in the store.
    """
    try:
        with store_errors(store.uri):
            run: Run = store.get_run(run_id)
    except TrackingUnavailableError:
        raise
    except TrackingError as error:
        raise TrackingError(f"{where}: {error}") from error
    if run.info.lifecycle_stage != "active":
        raise TrackingError(
            f"{where} names run {run_id}, which was deleted in MLflow: restore it with mlflow runs restore --run-id "
            f"{run_id}"
        )
    if run.info.experiment_id != experiment_id:
        raise TrackingError(
            f"{where} names run {run_id}, which is another's: it is in another experiment, and left "
            "unchanged (has tracking.experiment changed since?)"
        )
    if others := [name for name, value in tags.items() if run.data.tags.get(name) != value]:
        raise TrackingError(
            f"{where} names run {run_id}, which is another's, as its tag {others[0]} says: it is left unchanged"
        )
    return run


def load_agent_run(uri: str, run_id: str) -> FoundRun:
    """Return a run as `load_run` does, which must not be an evaluation.

    Raises:
        InvalidValueError: If it is one.
    """
    run = load_run(uri, run_id)
    if EVALUATED_TAG in run.tags:
        raise InvalidValueError(f"run is {run_id!r}, but that is an evaluation, of {run.tags[EVALUATED_TAG]}")
    return run


def check_run_id(run_id: str) -> None:
    """Raise `TrackingError` if a string cannot be an MLflow run ID or its beginning."""
    if not ID.fullmatch(run_id):
        raise TrackingError(
            f"the run is {run_id!r}, but it must be an ID as MLflow shows it, or its beginning: up to 32 of 0-9 and a-f"
        )


def check_version(run: Run) -> None:
    """Raise `TrackingError` if a newer version made a run, perhaps in another format, or its version is invalid."""
    version = run.data.tags.get(VERSION_TAG, armscan.__version__)
    try:
        is_newer = Version(version).release > Version(armscan.__version__).release
    except InvalidVersion as error:
        raise TrackingError(
            f"run {run.info.run_id}: its tag {VERSION_TAG} is {version[:50]!r}, not a version"
        ) from error
    if is_newer:
        raise TrackingError(
            f"run {run.info.run_id} was made by armscan {version}, but this is {armscan.__version__}: "
            "it needs that version or a newer one"
        )
