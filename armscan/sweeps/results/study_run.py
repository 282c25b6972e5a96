"""The result of a study as its run in MLflow shows it: metrics, and a note."""

from __future__ import annotations

import math
from collections.abc import Mapping

import optuna
from optuna.trial import FrozenTrial

from armscan.sweeps.results.difference import HOW
from armscan.sweeps.results.final_results import final_table
from armscan.sweeps.results.study_result import StudyResult
from armscan.sweeps.scheduling.state import CONTROL
from armscan.sweeps.storage.attribute_names import MEMBER, METRICS, OBJECTIVES
from armscan.sweeps.study.candidates import NOTHING_SEARCHED
from armscan.sweeps.study.study import best_trials
from armscan.tracking.tags import SELECTION_PREFIX, VALIDATION_PREFIX
from armscan.training.baselines import RANDOM
from armscan.training.episode_results import TEST_METRICS
from armscan.training.metric_display import leading_among
from armscan.training.metrics import ENDS
from armscan.utils.text import markdown_table

# Prefixes of the metrics of a study's run that compare the chosen configuration with the control.
COMPARISONS = ("difference", "probability_of_improvement")


def best_metrics(search: optuna.Study, result: StudyResult | None) -> dict[str, float]:
    """Return the leading metrics of a study's result, by the names that runs use; before it has one, of its best trial.

    Metrics that are not there are NaN, in place of those of an earlier result, which MLflow cannot delete: validation
    metrics of the control, differences, and intervals.

    Args:
        search: Study of the search.
        result: Its result; None without one.
    """
    best = best_trials(search, 1)
    found = _of_search(best[0]) if best else {}
    if result is None or (chosen := result.of_chosen) is None:
        return found
    found = dict.fromkeys(found, math.nan)
    if result.chosen != CONTROL:
        found |= _of_search(search.get_trials(deepcopy=False)[result.chosen])
    of_chosen = chosen.figures.metrics()
    found |= _leading(TEST_METRICS, of_chosen)
    if (of_random := chosen.baselines.get(RANDOM)) is not None:
        found |= _leading(RANDOM, of_random.metrics())
    compared = (*(name for name in search.user_attrs[OBJECTIVES] if name in of_chosen), *leading_among(of_chosen))
    found |= dict.fromkeys((name for key in COMPARISONS for each in compared for name in _names(key, each)), math.nan)
    for each in result.differences:
        for key, estimate in zip(COMPARISONS, (each.estimate, each.probability), strict=True):
            found |= dict(zip(_names(key, each.metric), estimate, strict=True))
    return found


def _of_search(trial: FrozenTrial) -> dict[str, float]:
    """Return the leading metrics that gave a trial of the search its value."""
    prefix = VALIDATION_PREFIX if MEMBER in trial.user_attrs else SELECTION_PREFIX
    return _leading(prefix.removesuffix("/"), trial.user_attrs.get(METRICS, {}))


def _leading(prefix: str, metrics: Mapping[str, float]) -> dict[str, float]:
    """Return the leading metrics that are not NaN, by their names in MLflow."""
    return {f"{prefix}/{name}": metrics[name] for name in leading_among(metrics) if not math.isnan(metrics[name])}


def _names(key: str, metric: str) -> list[str]:
    """Return the names of an estimate and of the ends of its interval."""
    return [f"{key}/{metric}{end}" for end in ("", *ENDS)]


def result_note(result: StudyResult | None) -> str:
    """Return the result of a study in Markdown, as the study prints it; empty before a configuration was tested."""
    if result is None or result.of_chosen is None:
        return ""
    settings = (f"{name}: {f'`{each}`' if each else NOTHING_SEARCHED}" for name, each in result.settings.items())
    parts = [f"**{result.summary}**", *settings, "The test volumes:", final_table(result.results).markdown()]
    if rows := [each.row() for each in result.differences]:
        parts += [f"{result.compared}:", markdown_table([*rows[0]], [[*row.values()] for row in rows]), HOW]
    return "\n\n".join([*parts, *(f"Note: {note}." for note in result.notes)])
