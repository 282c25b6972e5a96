"""Selection of a study's configuration: the candidates on the validation volumes, as rows and as a chart."""

from __future__ import annotations

import html
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from plotly.graph_objects import Figure

from armscan.reports.chart_style import BLUE, GREY, ORANGE, RATE_AXIS
from armscan.reports.charts import add_estimate
from armscan.reports.html import chart, table
from armscan.stats.bootstrap import Estimate
from armscan.sweeps.results.final_results import bounds_in
from armscan.sweeps.results.study_result import StudyResult
from armscan.sweeps.scheduling.race import END_LOSS, LEADER_SEEDS, Race
from armscan.sweeps.scheduling.state import CONTROL, StudyState
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.storage.attribute_names import OBJECTIVES
from armscan.sweeps.study.candidates import NOTHING_SEARCHED, key_of, name_of, settings_of
from armscan.sweeps.study.final_eval import FinalEvaluation
from armscan.training.metric_display import is_rate, title_of, value_text
from armscan.utils.text import counted

ROW_PX, AROUND_PX = 44, 110


class Candidate(NamedTuple):
    """A candidate of the selection.

    Args:
        number: Number of its trial, or `CONTROL`.
        scores: The objective on the validation volumes by seed, NaN for a training that failed.
        estimate: Its mean with the 95 % interval by which candidates are compared.
        n_seeds: Number of seeds that the estimate is over; before there is one, of those that have a score.
        outcome: Outcome of the race: `chosen`, `failed`, `violates a constraint`, `not chosen`, or `in the race`.
        settings: Its values as overrides.
    """

    number: int
    scores: dict[int, float]
    estimate: Estimate
    n_seeds: int
    outcome: str
    settings: str

    @property
    def name(self) -> str:
        """Name for users."""
        return name_of(self.number)

    def row(self, objective: str) -> dict[str, str]:
        """Return its row of a table: cells by column."""
        value, low, high = (value_text(objective, each) for each in self.estimate)
        is_known = math.isfinite(self.estimate.value)
        return {
            "candidate": self.name,
            "seeds": str(self.n_seeds),
            title_of(objective): value if is_known else "",
            "95 % interval": f"{low} to {high}" if self.estimate.has_width else "",
            "outcome": self.outcome,
        }


def objective_of(final: FinalEvaluation) -> str:
    """Return the metric that candidates are compared by."""
    return str(next(iter(final.search.user_attrs[OBJECTIVES])))


def candidates_of(final: FinalEvaluation) -> list[Candidate]:
    """Return the candidates: the chosen one first, then the others, those with the most seeds first."""
    scores_of, sign = final.scores(), final.sign
    race = final.race(scores_of)
    searched = final.search.get_trials(deepcopy=False)
    found = []
    for number, scores in scores_of.items():
        standing = race.standings[number]
        value, *ends = (sign * each for each in standing.estimate)
        estimate = Estimate(value, *sorted(ends))
        found.append(
            Candidate(
                number,
                {seed: sign * score for seed, score in sorted(scores.items())},
                estimate.clipped(*bounds_in(final.search, objective_of(final))),
                standing.n_seeds or sum(map(math.isfinite, scores.values())),
                _outcome(race, number),
                " ".join(overrides_of(settings_of(searched, number))),
            )
        )
    return sorted(found, key=lambda each: (each.number != race.chosen, -each.n_seeds, -sign * each.estimate.value))


def _outcome(race: Race, number: int) -> str:
    if number == race.chosen:
        return "chosen"
    if race.standings[number].has_failed:
        return "failed"
    if race.standings[number].is_withdrawn:
        return "violates a constraint"
    return "not chosen" if race.is_over else "in the race"


def selection_chart(candidates: Sequence[Candidate], objective: str) -> Figure:
    """Return a chart of the candidates with their intervals, and a dot for each seed."""
    figure = Figure()
    labels = [f"{each.name}, {each.outcome}" for each in candidates]
    for each, label in zip(candidates, labels, strict=True):
        colour = ORANGE if each.outcome == "chosen" else BLUE if each.number == CONTROL else GREY
        settings = html.escape(each.settings or NOTHING_SEARCHED)
        interval = f" ({each.estimate.low:.4g} to {each.estimate.high:.4g})" if each.estimate.has_width else ""
        hover = f"%{{x:.4g}}{interval}<br>{settings}<extra>{each.name}</extra>"
        scores = {f"seed {seed}": score for seed, score in each.scores.items()}
        add_estimate(figure, label, colour, each.estimate, scores, hover, each.name)
    axis: dict[str, Any] = {"title": f"{title_of(objective)}, validation volumes"}
    figure.update_xaxes(**axis, **(RATE_AXIS if is_rate(objective) else {}))
    figure.update_yaxes(autorange="reversed", automargin=True, categoryorder="array", categoryarray=labels)
    return figure.update_layout(height=AROUND_PX + ROW_PX * len(candidates))


def score_rows(candidates: Sequence[Candidate]) -> Iterator[dict[str, Any]]:
    """Yield the score of each training of the selection."""
    for each in candidates:
        for seed, score in each.scores.items():
            yield {"candidate": key_of(each.number), "seed": seed, "score": score, "outcome": each.outcome}


def decision_section(
    final: FinalEvaluation, result: StudyResult | None, candidates: Sequence[Candidate], searched: StudyState
) -> str:
    """Return an explanation in HTML, step by step, of how a study decided."""
    objective, settings = objective_of(final), final.settings
    better = "higher" if final.sign > 0 else "lower"
    n_selected = sum(len(each.scores) for each in candidates)
    n_candidates = max(0, len(candidates) - 1)
    n_seeds = counted(settings.min_seeds, "seed")
    further = (
        "Further seeds go, in rounds, to the candidates where they most increase the probability of a correct "
        f"selection. The race ends at {settings.mean_seeds} seeds of each on average, if one candidate is left, or "
        f"once the leader has {LEADER_SEEDS} seeds and the expected loss from choosing it is at most "
        f"{100 * END_LOSS:.0f} % of the standard deviation between seeds. "
    )
    steps = [
        f"<b>Search</b>: {counted(len(searched.finished), 'trial')}, {searched.n_pruned} of them pruned. Candidates "
        f"are its best different configurations ({n_candidates}); the control is {NOTHING_SEARCHED}.",
        f"<b>Selection</b>, on the validation volumes: {counted(n_selected, 'training')} with seeds that the search "
        f"has not used, compared by {html.escape(title_of(objective))} ({better} is better). Each "
        f"candidate, and the control, gets {n_seeds} first. "
        f"{further if settings.min_seeds < settings.mean_seeds else ''}"
        + (
            "The configuration with the best conservative bound is chosen."
            if settings.mean_seeds > 1
            else "The candidate with the best score is chosen: one seed gives no interval."
        ),
    ]
    if result is not None:
        tested = "the control alone" if result.chosen == CONTROL else f"{name_of(result.chosen)} and the control"
        steps.append(
            f"<b>Test</b>, on the test volumes: {tested}, with {counted(settings.test_seeds, 'seed')} of their own."
        )
    listed = "".join(f"<li>{step}</li>" for step in steps)
    if not candidates:
        return f"<h2>How this study decides</h2><ol>{listed}</ol>"
    drawn = chart(selection_chart(candidates, objective))
    rows = table([each.row(objective) for each in candidates])
    return f"<h2>How this study decides</h2><ol>{listed}</ol>{drawn}{rows}"
