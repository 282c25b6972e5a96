"""Load a training for a comparison: configuration, curves, final evaluation, video."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mlflow.entities import Run

from armscan.config.legacy import migrate
from armscan.errors import TrackingError
from armscan.reports.select import ID_CHARS, SelectedRuns
from armscan.tracking import TrackingStore
from armscan.tracking.store import store_errors
from armscan.training import TEST, Evaluation
from armscan.utils.files import EVALUATION_FILE, SHA256_TAGS, VIDEO_FILE, VOLUMES_FILE, sha256
from armscan.volumes.plane import FloatArray

WALL = "wall_s"
VALIDATION = {
    "validation/success_rate": "success rate",
    "validation/mean_steps": "mean steps",
    "validation/mean_return": "mean return",
}
# The beginnings of what else is drawn.
OF_THE_TRAINING = ("update/", "train/return", "train/length", "speed/")
BUDGET = "training.env_steps"
CHOICE = "choice."
# In the fingerprints of a run's volumes.
TEST_PART = "test"


@dataclass(frozen=True)
class Series:
    """How a figure went, one value for each epoch.

    Args:
        env_steps: at the end of each epoch, ascending, shape (epochs,).
        wall_s: seconds of the training by then, NaN where they are not known.
        values: of the figure.
    """

    env_steps: FloatArray
    wall_s: FloatArray
    values: FloatArray


@dataclass(frozen=True, kw_only=True)
class TrackedTraining:
    """One training.

    Args:
        run_id: of its run.
        name: of its run.
        status: of its run.
        started_ms: when it was started.
        is_whole: whether it has run to its end; not where it was pruned, fails, or is still running.
        params: its configuration, leaves by dotted keys.
        choices: what was chosen of each group of the configuration.
        series: by the name of the figure.
        evaluation: on the test volumes, None where it has kept none.
        volumes: fingerprints of its test volumes by name, None where it has kept none.
        video: an episode as an animated GIF, None where it has kept none.
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
    volumes: Mapping[str, str] | None = field(repr=False)
    video: bytes | None = field(repr=False)

    @property
    def id(self) -> str:
        """The beginning of its run's id, as people are shown it."""
        return self.run_id[:ID_CHARS]

    @property
    def seed(self) -> str | None:
        """As its configuration has it."""
        return self.params.get("seed")

    @property
    def label(self) -> str:
        """What tells it from the others of its group."""
        return f"seed {self.seed}" if self.seed is not None else f"run {self.id}"

    @property
    def env_steps(self) -> float:
        """That it has taken by its last validation; NaN where it has none, or nothing was to be learned."""
        return self._last(lambda series: series.env_steps)

    @property
    def wall_s(self) -> float:
        """Seconds that it took until then."""
        return self._last(lambda series: series.wall_s)

    @property
    def missing(self) -> list[str]:
        """Which files it has not kept that a comparison shows something of."""
        kept = {EVALUATION_FILE: self.evaluation, VIDEO_FILE: self.video}
        return [name for name, contents in kept.items() if contents is None]

    def _last(self, of: Any) -> float:
        ends = [float(of(each)[-1]) for name, each in self.series.items() if name in VALIDATION]
        return max(ends, default=float("nan"))


def read_training(store: TrackingStore, found: SelectedRuns, folder: Path) -> TrackedTraining:
    """Return what a run says of a training.

    Args:
        store: that it is in.
        found: the run.
        folder: takes its files.

    Raises:
        TrackingError: if a file of it is damaged, or the store cannot be used.
    """
    run, tags = found.run, found.run.data.tags
    folder.mkdir()
    with store_errors(store.uri):
        series = _series(store, run)
        files = _Files(store, run, folder)
        video, evaluation, volumes = files.contents(VIDEO_FILE), files.evaluation(), files.test_volumes()
    params = migrate(run.data.params)
    n_env_steps = max((each.env_steps[-1] for name, each in series.items() if name in VALIDATION), default=0.0)
    is_cut = found.is_pruned and n_env_steps < float(params.get(BUDGET, "inf"))
    return TrackedTraining(
        run_id=run.info.run_id,
        name=run.info.run_name or run.info.run_id,
        status="pruned" if is_cut and run.info.status == "FINISHED" else run.info.status.lower(),
        started_ms=run.info.start_time or 0,
        is_whole=run.info.status == "FINISHED" and not is_cut,
        params=params,
        choices={tag.removeprefix(CHOICE): value for tag, value in sorted(tags.items()) if tag.startswith(CHOICE)},
        series=series,
        evaluation=evaluation,
        volumes=volumes,
        video=video,
    )


def _series(store: TrackingStore, run: Run) -> dict[str, Series]:
    wanted = [name for name in run.data.metrics if name in VALIDATION or name.startswith(OF_THE_TRAINING)]
    wall_s = _history(store, run, WALL) if WALL in run.data.metrics else {}
    series = {}
    for name in sorted(wanted):
        points = sorted(_history(store, run, name).items())
        steps, values = (np.array(each, dtype=float) for each in zip(*points, strict=True))
        series[name] = Series(steps, np.array([wall_s.get(step, np.nan) for step, _ in points]), values)
    return series


def _history(store: TrackingStore, run: Run, name: str) -> dict[int, float]:
    return {point.step: point.value for point in store.get_metric_history(run.info.run_id, name)}


class _Files:
    """The files that a run has kept."""

    def __init__(self, store: TrackingStore, run: Run, folder: Path) -> None:
        self._store, self._run, self._folder = store, run, folder
        self._names = {artifact.path for artifact in store.list_artifacts(run.info.run_id)}

    def contents(self, name: str) -> bytes | None:
        if name not in self._names:
            return None
        return Path(self._store.download_artifacts(self._run.info.run_id, name, str(self._folder))).read_bytes()

    def evaluation(self) -> Evaluation | None:
        """Return the final evaluation on the test volumes."""
        if (contents := self.contents(EVALUATION_FILE)) is None:
            return None
        try:
            evaluation = Evaluation.of_plain(json.loads(contents)[TEST]["episodes"])
        except (ValueError, TypeError, KeyError) as error:
            raise self._damaged(EVALUATION_FILE) from error
        return evaluation if evaluation.episodes else None

    def test_volumes(self) -> dict[str, str] | None:
        """Return the fingerprints of the test volumes."""
        if (contents := self.contents(VOLUMES_FILE)) is None:
            return None
        if sha256(contents) != self._run.data.tags.get(SHA256_TAGS[VOLUMES_FILE], sha256(contents)):
            raise self._damaged(VOLUMES_FILE)
        try:
            return dict(json.loads(contents)[TEST_PART])
        except (ValueError, TypeError, KeyError) as error:
            raise self._damaged(VOLUMES_FILE) from error

    def _damaged(self, name: str) -> TrackingError:
        return TrackingError(f"run {self._run.info.run_id}: its {name} is damaged; put it back, or leave the run out")
