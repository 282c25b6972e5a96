"""A result in a few sentences: its on-plane rate, whether it beats random planes, and its distance from the plane.

The difference from the random agent is paired: the rates on each volume are compared, so that a volume that is easy
for both does not hide what the agent adds. Its interval is for other subjects and, with several trainings, other seeds.
If the difference is the same for all subjects, the interval is Newcombe's, which takes episodes as independent. For
one subject and several trainings, Newcombe's method combines the interval of the random agent's rate with that over
seeds, or with that of one training's episodes if it is wider.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from armscan.stats.bootstrap import Estimate
from armscan.stats.paired import crossed_mean, of_subjects, weighted_by_volume
from armscan.stats.proportions import difference_of_rates, wilson
from armscan.training.episode_results import Evaluation, subject_of_volumes
from armscan.training.metric_display import interval_text
from armscan.training.metrics import MetricEstimates
from armscan.utils.text import formatted

# Metric of an agent: difference of its leading on-plane rate from random planes'.
ABOVE_RANDOM = "on_plane_above_random"
# With fewer subjects, intervals are clearly too narrow: docs/metrics.md.
MIN_SUBJECTS = 8
# If the difference is the same on all volumes, only rounding gives its interval a width.
NO_WIDTH = 1e-9
DISTANCES = (("median_distance_mm", "{:.1f} mm"), ("median_distance_deg", "{:.1f}°"))


def beside_random(
    figures: MetricEstimates, trainings: Sequence[Evaluation], random: Evaluation | None
) -> MetricEstimates:
    """Return figures with the paired difference of the leading on-plane rate from random planes'.

    Args:
        figures: Figures of an agent.
        trainings: Episodes of each of its trainings, on the same volumes.
        random: Episodes of random planes; None if there are none.

    Returns:
        The figures; as they were if `random` is None or has other volumes.
    """
    theirs = _rates(random) if random is not None else {}
    ours = [_rates(each) for each in trainings]
    if not theirs or any(each.keys() != theirs.keys() for each in ours):
        return figures
    scores = np.array([[each[name] for name in theirs] for each in ours])
    assert random is not None
    subject_of = subject_of_volumes([random, *trainings])
    # As the rates do, the difference gives a volume the weight of its episodes.
    n_episodes = Counter(episode.volume for each in trainings for episode in each.episodes)
    weights = np.array([n_episodes[name] for name in theirs]) / np.mean([*n_episodes.values()])
    weighted = weighted_by_volume(scores - np.array([*theirs.values()]), weights)
    differences = of_subjects(weighted, [subject_of[name] for name in theirs])
    mean, half = crossed_mean(differences)
    above = Estimate.around(mean, half).clipped(-1.0, 1.0)
    # Of one training: the seeds play mostly the same episodes.
    of_one, of_random = _wilson_of(trainings[:1]), _wilson_of([random])
    if half < NO_WIDTH:
        above = difference_of_rates(of_one, of_random)
    elif differences.shape[1] == 1 and math.isfinite(half):
        # On one subject, the spread of the seeds contains neither the noise of their common episodes nor random's.
        rate, once = of_random.value + mean, [abs(end - of_one.value) for end in of_one[1:]]
        of_all = Estimate(rate, *(rate + sign * max(half, each) for sign, each in zip((-1, 1), once, strict=True)))
        above = difference_of_rates(of_all, of_random).clipped(-1.0, 1.0)
    return replace(figures, estimates={**figures.estimates, ABOVE_RANDOM: above})


def headline(results: Mapping[str, MetricEstimates], randoms: Mapping[str, MetricEstimates]) -> str:
    """Return the leading figures of a result, or of the one of several with the highest on-plane rate.

    Args:
        results: Figures of agents, by their names.
        randoms: Figures of random planes on the same volumes, by the names of `results`; some may be missing.

    Returns:
        Sentences such as `On plane, 5 mm 10°: agent 73.5% (61.0–85.0), random 56.5% (46.0–66.5). Better than random:
        +17.0 points (+2.3 to +31.7). Median distance 2.7 mm (2.0–3.4), 0.0°.`; empty if no result has the rate, or
        their leading limits differ.
    """
    known = {name: each for name, each in results.items() if each.on_plane}
    # Rates within different limits cannot be compared.
    if len({each.on_plane[0] for each in known.values()}) != 1:
        return ""
    limits = next(each.on_plane[0] for each in known.values())
    name = max(known, key=lambda each: known[each].estimates[limits.metric].value)
    best, random = known[name], randoms.get(name)
    # The highest of several is optimistically biased.
    which = f"best of {len(known)}, chosen on these volumes: {name}," if len(known) > 1 else name
    beside = "" if random is None else f", random {_text(random.estimate(limits.metric), '{:.1%}')}"
    far = ", ".join(_text(best.estimates[metric], form) for metric, form in DISTANCES if metric in best.estimates)
    sentences = (
        f"{limits.title.capitalize()}: {which} {_text(best.estimate(limits.metric), '{:.1%}')}{beside}.",
        _beside_random_text(best.estimates.get(ABOVE_RANDOM)),
        f"Median distance {far}." if far else "",
    )
    return " ".join(filter(None, sentences))


def _wilson_of(evaluations: Sequence[Evaluation]) -> Estimate:
    """Return the leading on-plane rate of all episodes, with Wilson's interval."""
    n_episodes = sum(len(each.episodes) for each in evaluations)
    return wilson(round(sum(each.on_plane_rate * len(each.episodes) for each in evaluations)), n_episodes)


def _rates(evaluation: Evaluation) -> dict[str, float]:
    return {name: each.on_plane_rate for name, each in evaluation.by_volume().items()}


def _beside_random_text(above: Estimate | None) -> str:
    """Return whether an agent is better than random planes, by the interval of the difference."""
    if above is None or math.isnan(above.value):
        return ""
    points = Estimate(*(100 * each for each in above))
    size = f"{points.value:+z.1f} points"
    if math.isnan(points.low):
        return f"Difference {size}, one subject and one seed: this allows no conclusion about others."
    interval = f"{size} ({points.low:+z.1f} to {points.high:+z.1f})"
    if points.low > 0:
        return f"Better than random: {interval}."
    return f"Worse than random: {interval}." if points.high < 0 else f"Not shown to be better than random: {interval}."


def _text(estimate: Estimate, form: str) -> str:
    """Return a figure and its interval, such as `2.7 mm (2.0–3.4)`."""
    number = form.replace(" mm", "").replace("°", "")
    low, high = (formatted(number, end) for end in estimate[1:])
    interval = interval_text(estimate, number) if low != high else ""
    return formatted(form, estimate.value) + (f" ({interval})" if interval else "")
