"""Differences of metrics between the chosen configuration of a study and the control, with their intervals."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np
import optuna
from optuna.trial import FrozenTrial

from armscan.stats.aggregation import probability_of_improvement
from armscan.stats.bootstrap import UNKNOWN, Estimate
from armscan.stats.paired import paired_difference
from armscan.sweeps.results.final_results import bounds_in, scores_of, subjects_of
from armscan.sweeps.scheduling.state import TEST_PREFIX, metrics_of_test
from armscan.sweeps.storage.attribute_names import METRICS, OBJECTIVES
from armscan.sweeps.study.task_check import MAXIMIZE
from armscan.training.metric_display import is_rate, leading_among, title_of, value_text
from armscan.utils.text import PERCENT, formatted, is_zero

HOW = (
    "A difference is the mean of the paired differences over all seeds and test volumes; its interval is for other "
    "seeds and subjects. The probability of improvement is the probability that a training of the chosen configuration "
    "is better on a volume than one of the control. Rates differ by percentage points."
)


class Difference(NamedTuple):
    """Difference of a metric between the chosen configuration and the control.

    Args:
        metric: Name of the metric.
        is_higher_better: Whether higher values are better.
        paired: Mean difference (chosen minus control) over the seeds and volumes, with its 95 % interval.
        probability: Probability that a training of the chosen one is better on a volume than one of the control.
        n_left_out: Number of test volumes that are left out, because a training has no value there. Default: 0.
    """

    metric: str
    is_higher_better: bool
    paired: Estimate
    probability: Estimate
    n_left_out: int = 0

    @property
    def is_constant(self) -> bool:
        """Whether all differences are equal up to rounding: then there is no interval."""
        return math.isfinite(self.paired.low) and not self.paired.has_width

    @property
    def estimate(self) -> Estimate:
        """The mean difference, without an interval if all differences are equal."""
        return self.paired.if_wide

    @property
    def direction(self) -> str:
        """Return `better` or `worse` according to the interval; empty if it includes 0, or there is none."""
        above, below = ("better", "worse") if self.is_higher_better else ("worse", "better")
        return above if self.estimate.low > 0 else below if self.estimate.high < 0 else ""

    def row(self) -> dict[str, str]:
        """Return its row of a table: cells by column."""
        _, low, high = map(self._text, self.paired)
        interval = f"{low} to {high}" if math.isfinite(self.paired.low) else ""
        if self.is_constant:
            interval = "none: all differences are equal"
        better = "higher" if self.is_higher_better else "lower"
        return {
            "on the test volumes": f"{title_of(self.metric)} ({better} is better)",
            "chosen minus control": self.value_text,
            "95 % interval": interval,
            "probability of improvement": (
                "" if math.isnan(self.probability.value) else formatted(PERCENT, self.probability.value)
            ),
            "its 95 % interval": _interval_of(self.probability),
        }

    @property
    def value_text(self) -> str:
        """The mean difference with its sign and unit, such as `+4.2 points`."""
        if math.isnan(self.paired.value):
            return ""
        return f"{self._text(self.paired.value)}{' points' if is_rate(self.metric) else ''}"

    def _text(self, value: float) -> str:
        size = value_text(self.metric, abs(value)).removesuffix("%")
        # A difference that is not 0 must not look like it.
        if value and is_zero(size):
            size = f"{abs(value):.2g}"
        return f"{'-' if value < 0 else '+'}{size}"


def _interval_of(probability: Estimate) -> str:
    if math.isnan(probability.low):
        return ""
    # A digit more where an end that excludes 50 % would be rounded to it.
    form = PERCENT
    if (probability.low > 0.5 or probability.high < 0.5) and "50%" in map(PERCENT.format, probability[1:]):
        form = "{:.1%}"
    return f"{formatted(form, probability.low)} to {formatted(form, probability.high)}"


def differences_of(
    search: optuna.Study, chosen: Sequence[FrozenTrial], control: Sequence[FrozenTrial]
) -> Iterator[Difference]:
    """Yield the differences of the metrics that all trainings have; both have the same seeds in the same order."""
    metrics = [trial.user_attrs[METRICS] for trial in (*chosen, *control)]
    common = set.intersection(*map(set, metrics))
    tested = [name for name in metrics_of_test(metrics[0]) if TEST_PREFIX + name in common]
    objectives, subject_of = search.user_attrs[OBJECTIVES], subjects_of((*chosen, *control))
    # First the objectives, by which the configuration was selected.
    for name in dict.fromkeys((*(name for name in objectives if name in tested), *leading_among(tested))):
        volumes, scores = scores_of(TEST_PREFIX + name, metrics)
        is_known = np.asarray(np.isfinite(scores).all(axis=0))
        is_higher_better = objectives[name] == MAXIMIZE if name in objectives else is_rate(name)
        if not is_known.any():
            # Without a common test volume, there is nothing to compare.
            if len(is_known) and name in objectives:
                yield Difference(name, is_higher_better, UNKNOWN, UNKNOWN, len(is_known))
            continue
        volumes, scores = [*compress(volumes, is_known)], scores[:, is_known]
        ours, theirs = scores[: len(chosen)], scores[len(chosen) :]
        sign = 1.0 if is_higher_better else -1.0
        probability = probability_of_improvement(sign * ours, sign * theirs)
        paired = paired_difference(ours, theirs, [subject_of.get(volume, volume) for volume in volumes])
        least, most = bounds_in(search, name)
        n_left_out = len(is_known) - len(volumes)
        yield Difference(name, is_higher_better, paired.clipped(least - most, most - least), probability, n_left_out)
