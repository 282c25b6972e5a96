"""Comparison of the metrics of two runs, point by point."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from armscan.tracking.histories import metric_histories
from armscan.tracking.system_metrics import PREFIX
from armscan.tracking.tags import SELECTION_PREFIX
from armscan.tracking.tracking_store import TrackingStore

# Prefixes of metrics of time and machine, which differ from run to run, and of those that a reproduction lacks.
LEFT_OUT = (PREFIX, "speed/", "wall_s", "training_s", SELECTION_PREFIX)
N_SHOWN = 10


@dataclass(frozen=True)
class Difference:
    """Difference of one metric between two runs.

    Args:
        metric: Name of the metric.
        n_points: Number of steps at which both runs have it.
        n_missing: Number of steps at which only the first has it.
        n_new: Number of steps at which only the second has it; the first may have been interrupted.
        largest: Largest absolute difference, 0 if all points are equal. Default: None, no points in common.
        at_step: Environment step of the largest difference. Default: None.
        then: Value at that step in the first run. Default: None.
        now: Value at that step in the second run. Default: None.
    """

    metric: str
    n_points: int
    n_missing: int
    n_new: int
    largest: float | None = None
    at_step: int | None = None
    then: float | None = None
    now: float | None = None

    @property
    def is_same(self) -> bool:
        """Whether the second run has all points of the first, equal to the last bit."""
        return self.n_missing == 0 and self.largest == 0.0

    @property
    def relative(self) -> float:
        """Largest difference, as a share of the first run's value there; infinite if that is 0, NaN or missing."""
        share = abs(self.largest / self.then) if self.largest is not None and self.then else math.inf
        # Of two infinite numbers, or of NaN.
        return math.inf if math.isnan(share) else share

    def __str__(self) -> str:
        """Return the difference in one line."""
        if self.largest is None:
            return f"{self.metric}: none of its {self.n_missing} points was reproduced"
        missing = f"; {self.n_missing} points are missing" if self.n_missing else ""
        if self.largest == 0.0:
            return f"{self.metric}: the same{missing}"
        share = f" ({self.relative:.2%})" if math.isfinite(self.relative) else ""
        return (
            f"{self.metric}: by {self.largest:.3g}{share} at step {self.at_step}, where {self.then:.6g} became "
            f"{self.now:.6g}{missing}"
        )


@dataclass(frozen=True)
class Comparison:
    """Comparison of the metrics of two runs: the difference of each metric that the first run has."""

    differences: tuple[Difference, ...]

    @property
    def is_same(self) -> bool:
        """Whether the second run has all metrics of the first, equal to the last bit."""
        return bool(self.differences) and all(each.is_same for each in self.differences)

    def lines(self) -> list[str]:
        """Return the lines to print."""
        n_points = sum(each.n_points for each in self.differences)
        if not self.differences:
            return ["not the same: the first run has no metrics"]
        if self.is_same:
            return [f"the same: {n_points} points of {len(self.differences)} metrics, to the last bit"]
        # Missing points first, then the largest relative differences.
        unlike = [each for each in self.differences if not each.is_same]
        unlike.sort(key=lambda each: (each.largest is None, each.n_missing > 0, each.relative), reverse=True)
        more = [f"... and {len(unlike) - N_SHOWN} more"] if len(unlike) > N_SHOWN else []
        told = f"not the same: {len(unlike)} of {len(self.differences)} metrics differ"
        return [told, *(f"  {each}" for each in unlike[:N_SHOWN]), *more]

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, ready for JSON: missing measurements are None, NaN and infinity strings."""
        metrics = [
            {
                name: str(value) if isinstance(value, float) and not math.isfinite(value) else value
                for name, value in each
            }
            for each in (asdict(each).items() for each in self.differences)
        ]
        return {"is_same": self.is_same, "metrics": metrics}


def compare_runs(store: TrackingStore, first_id: str, second_id: str) -> Comparison:
    """Compare the metrics of two runs of a store, the original first.

    Those of time and machine are left out, and those that only a study measures, which a reproduction does not.
    """
    names = {
        run_id: [name for name in store.get_run(run_id).data.metrics if not name.startswith(LEFT_OUT)]
        for run_id in (first_id, second_id)
    }
    histories = metric_histories(store, names)
    first, second = histories[first_id], histories[second_id]
    return Comparison(tuple(difference(name, then, second.get(name, {})) for name, then in sorted(first.items())))


def difference(metric: str, then: Mapping[int, float], now: Mapping[int, float]) -> Difference:
    """Return how a metric differs between two runs.

    Args:
        metric: Name of the metric.
        then: Values of the original run by environment step.
        now: Values of the other run by environment step.
    """
    common = sorted(then.keys() & now.keys())
    n_missing, n_new = len(then.keys() - now.keys()), len(now.keys() - then.keys())
    if not common:
        return Difference(metric, 0, n_missing, n_new)
    sizes = {step: _size(then[step], now[step]) for step in common}
    at = max(common, key=lambda step: sizes[step])
    return Difference(metric, len(common), n_missing, n_new, sizes[at], at, then[at], now[at])


def _size(then: float, now: float) -> float:
    """Return the size of a difference: 0 for equal infinities or two NaNs, infinite if one alone is NaN."""
    if then == now or (math.isnan(then) and math.isnan(now)):
        return 0.0
    return math.inf if math.isnan(then - now) else abs(then - now)
