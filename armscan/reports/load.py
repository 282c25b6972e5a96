"""Load a training for a comparison: configuration, curves, final evaluation, video."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from mlflow.entities import Run

from armscan.config.defaults import FOLD, FOLDS
from armscan.config.legacy import migrate
from armscan.errors import TrackingError
from armscan.stats.on_plane import leading_of, limits_among
from armscan.tracking import TrackingStore
from armscan.tracking.histories import History, metric_histories
from armscan.tracking.run import PRUNED
from armscan.tracking.store import store_errors
from armscan.tracking.tags import (
    BEST_ENV_STEP,
    CHOICE,
    COMMIT_TAG,
    OVERRIDES_TAG,
    OWN_CODE_TAG,
    PRUNED_TAG,
    VALIDATION_PREFIX,
    VERSION_TAG,
)
from armscan.training import TEST, Evaluation
from armscan.training.fingerprints import Fingerprints, fingerprints_in
from armscan.training.metric_display import title_of
from armscan.utils.arrays import FloatArray
from armscan.utils.run_files import (
    BASELINES_FILE,
    EVALUATION_FILE,
    ID_CHARS,
    VIDEO_FILE,
    VOLUMES_FILE,
    is_as_tagged,
)

WALL = "wall_s"
VALIDATION = {f"{VALIDATION_PREFIX}{name}": title_of(name) for name in ("success_rate", "mean_steps", "mean_return")}
# Prefixes of the other metrics that are drawn.
OF_THE_TRAINING = ("update/", "train/return", "train/length", "speed/")
# MLflow's value of a parameter that is not set.
UNSET = "None"
T = TypeVar("T")


@dataclass(frozen=True)
class Series:
    """A metric over training, with one value for each epoch.

    Args:
        env_steps: Environment steps at the end of each epoch, ascending, shape (epochs,).
        wall_s: Seconds of training until then; NaN if not known.
        values: Values of the metric, shape (epochs,).
    """

    env_steps: FloatArray
    wall_s: FloatArray
    values: FloatArray


@dataclass(frozen=True, kw_only=True)
class TrackedTraining:
    """One training.

    Args:
        run_id: MLflow run ID.
        name: Name of the run.
        status: Status of the run, in lower case; `pruned` if it was cut off with its trial.
        started_ms: Start time, in ms since 1970.
        is_whole: Whether it has run to its end: not pruned, failed or still running.
        params: Its configuration, by dotted keys.
        choices: Choice of each configuration group.
        series: Curves by the name of the metric.
        evaluation: Final evaluation on the test volumes; None if it has kept none.
        baselines: Episodes of the baselines on the test volumes, by their names. Default: none, as in older runs.
        overridden: Keys that its command line set. Default: none.
        own_code: Checksums of the modules of own classes, as a tag has them. Default: None, not known, or none.
        commit: Commit of the code, or the version of an installed package. Default: None, not known.
        volumes: Fingerprints of its volumes by split (training, validation, test) and name; None if it has kept none.
        video: Episode as an animated GIF; None if it has kept none.
        best_env_steps: Environment steps at the end of the epoch whose weights it has kept. Default: NaN, not known.
    """

    run_id: str
    name: str
    status: str
    started_ms: int
    is_whole: bool
    params: Mapping[str, str] = field(repr=False)
    choices: Mapping[str, str]
    series: Mapping[str, Series] = field(repr=False)
    evaluation: Evaluation | None = field(repr=False)
    baselines: Mapping[str, Evaluation] = field(default_factory=dict, repr=False)
    overridden: frozenset[str] = frozenset()
    own_code: str | None = None
    commit: str | None = None
    volumes: Fingerprints | None = field(repr=False)
    video: bytes | None = field(repr=False)
    best_env_steps: float = math.nan

    @property
    def id(self) -> str:
        """First characters of its run ID, as shown to users."""
        return self.run_id[:ID_CHARS]

    @property
    def seed(self) -> str | None:
        """Seed of its configuration."""
        return self.params.get("seed")

    @property
    def seed_key(self) -> str:
        """Its seed; its run ID if its configuration has none, so that it counts as a seed of its own."""
        return self.seed or self.run_id

    @property
    def fold(self) -> str | None:
        """Fold of a cross-validation that it was tested on; None if it is of none."""
        return self.params.get(FOLD) if self.params.get(FOLDS, UNSET) != UNSET else None

    @property
    def label(self) -> str:
        """Label within its group: the seed or the run ID, and the fold."""
        label = f"seed {self.seed}" if self.seed is not None else f"run {self.id}"
        return label if self.fold is None else f"{label}, fold {self.fold}"

    @property
    def env_steps(self) -> float:
        """Environment steps at its last validation; NaN without a validation."""
        return self._last("env_steps")

    @property
    def wall_s(self) -> float:
        """Seconds of training until then."""
        return self._last("wall_s")

    @property
    def missing(self) -> list[str]:
        """Names of the missing files that a comparison shows."""
        kept = {EVALUATION_FILE: self.evaluation, VIDEO_FILE: self.video}
        return [name for name, contents in kept.items() if contents is None]

    def _last(self, axis: str) -> float:
        ends = [float(getattr(self.series[name], axis)[-1]) for name in validation_titles(self.series)]
        return max(ends, default=float("nan"))


def validation_titles(names: Iterable[str]) -> dict[str, str]:
    """Return the titles of those metrics that are of the validation, the on-plane rates first."""
    known = set(names)
    rates = limits_among(
        name.removeprefix(VALIDATION_PREFIX) for name in sorted(known) if name.startswith(VALIDATION_PREFIX)
    )
    titles = {f"{VALIDATION_PREFIX}{limits.metric}": limits.title for limits in rates}
    return titles | {name: title for name, title in VALIDATION.items() if name in known}


def read_trainings(store: TrackingStore, runs: Sequence[Run], folder: Path) -> list[TrackedTraining]:
    """Load the trainings of runs.

    Args:
        store: Store of the runs.
        runs: Runs to load.
        folder: Folder that their files are downloaded to.

    Raises:
        TrackingError: If one of their files is damaged, or the store cannot be used.
    """
    with store_errors(store.uri):
        leading = {f"{VALIDATION_PREFIX}{leading_of(migrate(run.data.params)).metric}" for run in runs}
        shown = {WALL, *VALIDATION, *leading}
        histories = metric_histories(store, {run.info.run_id: _wanted(run, shown) for run in runs})
        # Not by run ID, which may be a path in an untrusted store.
        files = [_files(store, run, folder / str(number)) for number, run in enumerate(runs)]
    return [_training(run, histories[run.info.run_id], of_run) for run, of_run in zip(runs, files, strict=True)]


def _training(run: Run, histories: Mapping[str, History], files: Mapping[str, bytes]) -> TrackedTraining:
    tags, series = run.data.tags, _series(histories)
    evaluation = _parsed(run, files, EVALUATION_FILE, lambda contents: Evaluation.of_dict(contents[TEST]))
    baselines = _parsed(run, files, BASELINES_FILE, _played)
    params = migrate(run.data.params)
    # The tag of its own run: other seeds of a pruned trial may have run to their end.
    is_pruned = PRUNED_TAG in tags
    return TrackedTraining(
        run_id=run.info.run_id,
        name=(run.info.run_name or run.info.run_id).removesuffix(PRUNED),
        status="pruned" if is_pruned and run.info.status == "FINISHED" else run.info.status.lower(),
        started_ms=run.info.start_time or 0,
        is_whole=run.info.status == "FINISHED" and not is_pruned,
        params=params,
        choices={tag.removeprefix(CHOICE): value for tag, value in sorted(tags.items()) if tag.startswith(CHOICE)},
        series=series,
        evaluation=evaluation if evaluation and evaluation.episodes else None,
        baselines=baselines or {},
        overridden=frozenset(each.lstrip("+").partition("=")[0] for each in tags.get(OVERRIDES_TAG, "").split()),
        own_code=tags.get(OWN_CODE_TAG),
        commit=tags.get(COMMIT_TAG, tags.get(VERSION_TAG)),
        volumes=_parsed(run, files, VOLUMES_FILE, lambda contents: fingerprints_in(contents, VOLUMES_FILE)),
        video=files.get(VIDEO_FILE),
        best_env_steps=float(run.data.metrics.get(BEST_ENV_STEP, math.nan)),
    )


def _played(contents: Mapping[str, Any]) -> dict[str, Evaluation]:
    """Return evaluations by name, those with episodes."""
    evaluations = {name: Evaluation.of_dict(each) for name, each in contents.items()}
    return {name: each for name, each in evaluations.items() if each.episodes}


def _wanted(run: Run, shown: Collection[str]) -> list[str]:
    """Return the names of the metrics of a run that a comparison draws: those to show, and of the training itself."""
    return [name for name in run.data.metrics if name in shown or name.startswith(OF_THE_TRAINING)]


def _series(histories: Mapping[str, History]) -> dict[str, Series]:
    wall_s = histories.get(WALL, {})
    series = {}
    for name, history in sorted(histories.items()):
        if name != WALL and history:
            steps = sorted(history)
            values = np.array([history[step] for step in steps], dtype=float)
            seconds = np.array([wall_s.get(step, np.nan) for step in steps])
            series[name] = Series(np.array(steps, dtype=float), seconds, values)
    return series


def _files(store: TrackingStore, run: Run, folder: Path) -> dict[str, bytes]:
    """Return the contents of those files that a comparison needs and the run has kept."""
    folder.mkdir(parents=True)
    repository: Any = store.artifacts(run)
    names = {artifact.path for artifact in repository.list_artifacts()}
    return {
        name: Path(repository.download_artifacts(name, str(folder))).read_bytes()
        for name in names & {EVALUATION_FILE, BASELINES_FILE, VIDEO_FILE, VOLUMES_FILE}
    }


def _parsed(run: Run, files: Mapping[str, bytes], name: str, read: Callable[[Any], T]) -> T | None:
    """Return the contents of a run's JSON file; None if the run has none."""
    if (contents := files.get(name)) is None:
        return None
    damaged = TrackingError(f"run {run.info.run_id}: its {name} is damaged; put it back, or leave the run out")
    if not is_as_tagged(name, contents, run.data.tags):
        raise damaged
    try:
        return read(json.loads(contents))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise damaged from error
