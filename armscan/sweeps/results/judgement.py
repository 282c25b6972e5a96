"""The result of a study: the chosen configuration compared with the control on the test volumes, seed by seed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import compress
from typing import NamedTuple

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from armscan.experiment.results import volume_notes
from armscan.stats.aggregation import probability_of_improvement
from armscan.stats.bootstrap import UNKNOWN, Estimate
from armscan.stats.paired import paired_difference
from armscan.sweeps.results.final_results import (
    ConfigResult,
    bounds_in,
    final_results,
    final_table,
    scores_of,
    subjects_of,
)
from armscan.sweeps.scheduling.state import CONTROL, TEST_PREFIX, metrics_of_test
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.storage.attribute_names import METRICS, OBJECTIVES
from armscan.sweeps.study.candidates import NOTHING_SEARCHED, name_of, settings_of, training_of
from armscan.sweeps.study.final_eval import FinalEvaluation, to_judge
from armscan.sweeps.study.study import best_trials, change_notes
from armscan.training.baselines import RANDOM
from armscan.training.episode_results import TEST_METRICS
from armscan.training.headline import headline
from armscan.training.metric_display import is_rate, leading_among, title_of, value_text
from armscan.training.metrics import ENDS
from armscan.utils.text import PERCENT, counted, formatted, is_zero, markdown_table

MAXIMIZE = "maximize"
# Prefixes of the metrics of a study's run that compare the chosen configuration with the control.
COMPARISONS = ("difference", "probability_of_improvement")
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
    def verdict(self) -> str:
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


@dataclass(frozen=True)
class Judgement:
    """Judgement of the chosen configuration on the test volumes.

    Args:
        chosen: Number of the chosen trial, or `CONTROL`.
        results: Results of the chosen one and the control, as far as their trainings have finished.
        differences: Differences of the objectives and of the leading metrics; none where the control was chosen.
        n_seeds: Number of seeds that both have been trained with.
        n_planned: Number of seeds planned for both.
        others: Other trials evaluated on the test volumes, because the study continued after its end.
        settings: Overrides of the chosen one and the control, by their names; an empty string without any.
        n_unjudged: Number of trainings that have not ended. Default: 0.
        have_others_failed: Whether a training of every other candidate failed in the race. Default: False.
        violated: Constraints of the study that configurations violated in the race. Default: none.
        is_repeated: Whether trainings with an earlier configuration of the study were judged before. Default: False.
        changes: Notes on changes of the study's configuration. Default: none.
    """

    chosen: int
    results: tuple[ConfigResult, ...]
    differences: tuple[Difference, ...]
    n_seeds: int
    n_planned: int
    others: tuple[int, ...]
    settings: Mapping[str, str]
    n_unjudged: int = 0
    have_others_failed: bool = False
    violated: Mapping[int, Sequence[str]] = field(default_factory=dict)
    is_repeated: bool = False
    changes: Sequence[str] = ()

    @property
    def notes(self) -> list[str]:
        """Notes on the judgement."""
        notes = [*self.changes]
        if self.n_seeds < self.n_planned:
            notes.append(f"only {self.n_seeds} of {self.n_planned} seeds have been trained to their end")
        for number, violated in self.violated.items():
            name = "the control" if number == CONTROL else name_of(number)
            but = "" if self.chosen in self.violated else ", so it could not be chosen"
            notes.append(f"{name} violates {' and '.join(violated)} in the race{but}")
        notes += (
            f"{title_of(each.metric)} is compared without {counted(each.n_left_out, 'test volume')}: "
            "a training has no value there"
            for each in self.differences
            if each.n_left_out
        )
        if self.is_repeated:
            notes.append("the test volumes were used before, with another configuration of the study")
        if names := ", ".join(map(name_of, self.others)):
            notes.append(f"the test volumes were used before for {names}: the study went on after its end")
        return [*notes, *(volume_notes(self.results[0].figures) if self.results else ())]

    @property
    def compared(self) -> str:
        """The compared configurations and their seeds."""
        seeds = counted(self.n_seeds, "new seed")
        return f"{name_of(self.chosen).capitalize()} and the control, both with the same {seeds}"

    @property
    def of_chosen(self) -> ConfigResult | None:
        """The result of the chosen configuration; None before one of its trainings has finished."""
        return next((each for each in self.results if each.number == self.chosen), None)

    @property
    def result(self) -> str:
        """The result: the statement, and the chosen configuration beside random planes."""
        ours = {name_of(each.number): each for each in self.results if each.number == self.chosen}
        randoms = {name: each.baselines[RANDOM] for name, each in ours.items() if RANDOM in each.baselines}
        return f"{self.statement} {headline({name: each.figures for name, each in ours.items()}, randoms)}".strip()

    @property
    def statement(self) -> str:
        """The comparison with the control in a sentence."""
        if self.chosen == CONTROL and self.have_others_failed:
            return "The default configuration was chosen, because trainings of all other candidates have failed."
        if self.chosen == CONTROL:
            of_them = " that keeps all constraints" if self.violated and CONTROL not in self.violated else ""
            return f"No setting{of_them} beat the default configuration in the selection, on the validation volumes."
        name = name_of(self.chosen).capitalize()
        if not self.differences and self.n_unjudged:
            return f"{name} was chosen; it has not been judged beside the control yet."
        if not self.differences:
            reason = f"{self.n_seeds} of {self.n_planned} seeds were trained to their end with both"
            if self.n_seeds:
                reason = "their trainings have no test volume in common"
            return f"{name} was chosen, but it cannot be compared with the control: {reason}."
        first = self.differences[0]
        if math.isnan(first.paired.value):
            return (
                f"{name} was chosen, but it cannot be compared with the control ({title_of(first.metric)}): no test "
                "volume has a value in every training."
            )
        if math.isnan(first.paired.low):
            return f"{name} was chosen; one seed does not show whether it is better than the control."
        if first.is_constant:
            return (
                f"{name} was chosen; its difference from the control is {first.value_text} for every seed and "
                f"volume ({title_of(first.metric)})."
            )
        if first.verdict:
            return f"{name} is {first.verdict} than the control ({title_of(first.metric)})."
        return (
            f"{name} was chosen, but the test volumes do not show that it is better than the control: the interval of "
            f"the difference contains 0 ({title_of(first.metric)})."
        )


def _interval_of(probability: Estimate) -> str:
    if math.isnan(probability.low):
        return ""
    # A digit more where an end that excludes 50 % would be rounded to it.
    form = PERCENT
    if (probability.low > 0.5 or probability.high < 0.5) and "50%" in map(PERCENT.format, probability[1:]):
        form = "{:.1%}"
    return f"{formatted(form, probability.low)} to {formatted(form, probability.high)}"


def judge(final: FinalEvaluation) -> Judgement | None:
    """Return the judgement on the test volumes; None before a configuration is chosen."""
    race = final.race()
    if (chosen := race.chosen) is None:
        return None
    judged = final.judged()
    both = to_judge(race)
    now = [judged[number, seed] for number in both for seed in final.judge_seeds if (number, seed) in judged]
    seeds = [seed for seed in final.judge_seeds if all((number, seed) in judged for number in both)]
    pairs = [[judged[number, seed] for seed in seeds] for number in both]
    differences = _differences(final.search, *pairs) if seeds and chosen != CONTROL else ()
    complete = final.judgement.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    others = sorted({training_of(trial)[0] for trial in complete} - set(both))
    results, searched = tuple(final_results(now)), final.search.get_trials(deepcopy=False)
    of_others = [standing for number, standing in race.standings.items() if number != CONTROL]
    return Judgement(
        chosen=chosen,
        results=results,
        differences=tuple(differences),
        n_seeds=len(seeds),
        n_planned=len(final.judge_seeds),
        others=tuple(others),
        settings={name_of(each.number): " ".join(overrides_of(settings_of(searched, each.number))) for each in results},
        n_unjudged=final.n_unjudged,
        violated={number: each for number, each in final.violated().items() if number in race.standings},
        is_repeated=not all(map(final.is_current, complete)),
        changes=change_notes(final.search),
        have_others_failed=bool(of_others) and all(standing.has_failed for standing in of_others),
    )


def best_metrics(search: optuna.Study, judgement: Judgement | None) -> dict[str, float]:
    """Return the leading metrics of a study's result, by the names that runs use; before it has one, of its best trial.

    Metrics that are not there are NaN, in place of those of an earlier result, which MLflow cannot delete: validation
    metrics of the control, differences, and intervals.

    Args:
        search: Study of the search.
        judgement: Its judgement; None without one.
    """
    best = best_trials(search, 1)
    found = _leading("validation", best[0].user_attrs.get(METRICS, {}) if best else {})
    if judgement is None or (chosen := judgement.of_chosen) is None:
        return found
    found = dict.fromkeys(found, math.nan)
    if judgement.chosen != CONTROL:
        trials = search.get_trials(deepcopy=False)
        found |= _leading("validation", trials[judgement.chosen].user_attrs.get(METRICS, {}))
    of_chosen = chosen.figures.metrics()
    found |= _leading(TEST_METRICS, of_chosen)
    if (of_random := chosen.baselines.get(RANDOM)) is not None:
        found |= _leading(RANDOM, of_random.metrics())
    compared = (*(name for name in search.user_attrs[OBJECTIVES] if name in of_chosen), *leading_among(of_chosen))
    found |= dict.fromkeys((name for key in COMPARISONS for each in compared for name in _names(key, each)), math.nan)
    for each in judgement.differences:
        for key, estimate in zip(COMPARISONS, (each.estimate, each.probability), strict=True):
            found |= dict(zip(_names(key, each.metric), estimate, strict=True))
    return found


def _leading(prefix: str, metrics: Mapping[str, float]) -> dict[str, float]:
    """Return the leading metrics that are not NaN, by their names in MLflow."""
    return {f"{prefix}/{name}": metrics[name] for name in leading_among(metrics) if not math.isnan(metrics[name])}


def _names(key: str, metric: str) -> list[str]:
    """Return the names of an estimate and of the ends of its interval."""
    return [f"{key}/{metric}{end}" for end in ("", *ENDS)]


def result_note(judgement: Judgement | None) -> str:
    """Return the result of a study in Markdown, as the study prints it; empty before a configuration was judged."""
    if judgement is None or judgement.of_chosen is None:
        return ""
    settings = (f"{name}: {f'`{each}`' if each else NOTHING_SEARCHED}" for name, each in judgement.settings.items())
    parts = [f"**{judgement.result}**", *settings, "The test volumes:", final_table(judgement.results).markdown()]
    if rows := [each.row() for each in judgement.differences]:
        parts += [f"{judgement.compared}:", markdown_table([*rows[0]], [[*row.values()] for row in rows]), HOW]
    return "\n\n".join([*parts, *(f"Note: {note}." for note in judgement.notes)])


def _differences(
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
