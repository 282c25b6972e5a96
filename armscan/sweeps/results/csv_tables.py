"""Every number of a study's report, as rows of CSV files."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Iterator, Sequence

import optuna
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from armscan.reports.html import Row
from armscan.sweeps.results.final_results import ConfigResult
from armscan.sweeps.results.selection import Candidate, score_rows
from armscan.sweeps.results.study_result import StudyResult
from armscan.sweeps.scheduling.population import searched_values
from armscan.sweeps.scheduling.state import TEST_PREFIX, comparable_trials, is_feasible, seconds_of, was_retried
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.storage.attribute_names import (
    ENV_STEPS,
    FAILURE,
    GENERATION,
    MEMBER,
    METRICS,
    OBJECTIVES,
    PARENT,
    RETRY_OF,
    RUN,
    SCHEDULE,
    STOP,
    TAKEN_FROM,
)
from armscan.sweeps.storage.reports import reports_of
from armscan.sweeps.study.candidates import key_of

MIN_TRIALS_FOR_IMPORTANCE = 4


def all_numbers(
    study: optuna.Study,
    trials: Sequence[FrozenTrial],
    found: Sequence[ConfigResult],
    candidates: Sequence[Candidate],
    result: StudyResult | None,
) -> dict[str, list[Row]]:
    """Return the tables by the names of their files.

    Args:
        study: The study in its storage.
        trials: Its trials.
        found: Results on the test volumes; empty without a final evaluation.
        candidates: Candidates of the selection; empty without one.
        result: Result of the study; None before one was chosen.
    """
    objectives = list(study.user_attrs[OBJECTIVES])
    return {
        "trials": [_trial_row(trial, objectives) for trial in trials],
        "reports": [
            {"trial": trial.number, "step": step, "objective": name, "value": value}
            for trial in trials
            # Its retry has its reports.
            if not was_retried(trial)
            for step, values in reports_of(trial).items()
            for name, value in zip(objectives, values, strict=True)
        ],
        "endings": _ending_rows(trials),
        "failures": [
            {"trial": trial.number, "cause": cause_of(trial), "values": " ".join(overrides_of(searched_values(trial)))}
            for trial in trials
            if trial.state == TrialState.FAIL
        ],
        "result": list(_result_rows(found)),
        "importances": _importance_rows(study, objectives),
        "selection": [*score_rows(candidates)],
        "differences": [*_difference_rows(result)] if result is not None else [],
    }


def cause_of(trial: FrozenTrial) -> str:
    """Return why a trial has failed."""
    cause = str(trial.user_attrs.get(FAILURE, "not known"))
    return f"{cause}, retried" if was_retried(trial) else cause


def _trial_row(trial: FrozenTrial, objectives: Sequence[str]) -> Row:
    values = dict(zip(objectives, trial.values or (), strict=False)) if trial.state == TrialState.COMPLETE else {}
    metrics = {f"metric/{name}": value for name, value in trial.user_attrs.get(METRICS, {}).items()}
    return {
        "trial": trial.number,
        "state": trial.state.name.lower(),
        "retried": was_retried(trial),
        **values,
        **({"feasible": is_feasible(trial)} if trial.constraints else {}),
        "seconds": seconds_of(trial),
        "env_steps_of_all_seeds": trial.user_attrs.get(ENV_STEPS),
        "retry_of": trial.user_attrs.get(RETRY_OF),
        **({"taken_from": trial.user_attrs[TAKEN_FROM]} if TAKEN_FROM in trial.user_attrs else {}),
        **{name: trial.user_attrs[name] for name in (MEMBER, GENERATION, PARENT) if name in trial.user_attrs},
        **({SCHEDULE: json.dumps(trial.user_attrs[SCHEDULE])} if SCHEDULE in trial.user_attrs else {}),
        "mlflow_run": trial.user_attrs.get(RUN),
        **trial.params,
        **metrics,
    }


def _ending_rows(trials: Sequence[FrozenTrial]) -> list[Row]:
    """Return how many trials are in each state, and which, by cause."""
    of_ending: dict[tuple[str, str], list[int]] = {}
    for trial in trials:
        cause = ""
        if trial.state == TrialState.FAIL:
            cause = cause_of(trial)
        elif trial.state == TrialState.PRUNED:
            cause = f"behind the others at environment step {max(reports_of(trial), default='unknown')}"
            if STOP in trial.user_attrs:
                cause = f"stopped: {trial.user_attrs[STOP]}"
        of_ending.setdefault((trial.state.name.lower(), cause), []).append(trial.number)
    return [
        {"ending": ending, "cause": cause, "trials": len(numbers), "which": " ".join(map(str, numbers))}
        for (ending, cause), numbers in sorted(of_ending.items())
    ]


def _difference_rows(result: StudyResult) -> Iterator[Row]:
    for each in result.differences:
        yield {
            "chosen": key_of(result.chosen),
            "metric": f"{TEST_PREFIX}{each.metric}",
            "seeds": result.n_seeds,
            **dict(zip(("difference", "low", "high"), each.estimate, strict=True)),
            **dict(zip(("probability", "probability_low", "probability_high"), each.probability, strict=True)),
        }


def _result_rows(found: Sequence[ConfigResult]) -> Iterator[Row]:
    """Yield every metric of the result, including those of the baselines."""
    for result in found:
        for of, figures in {"agent": result.figures, **result.baselines}.items():
            for name in figures.estimates:
                value, low, high = figures.estimate(name)
                row = {"trial": key_of(result.number), "of": of, "seeds": figures.n_seeds}
                yield row | {"metric": f"{TEST_PREFIX}{name}", "value": value, "low": low, "high": high}


def _importance_rows(study: optuna.Study, objectives: Sequence[str]) -> list[Row]:
    """Return how much each key sets the best trials apart, relative to all keys.

    Empty if too few have finished that violate no constraint, or all of these are equal.
    """
    # PED-ANOVA: Watanabe et al. 2023, arXiv:2304.10255.
    rows: list[Row] = []
    trials = comparable_trials(study.get_trials(deepcopy=False))
    for number, (objective, direction) in enumerate(zip(objectives, study.directions, strict=True)):
        alone = study_of_one_objective(trials, number, direction)
        if len(trials) < MIN_TRIALS_FOR_IMPORTANCE or len({trial.value for trial in alone.trials}) == 1:
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            shares = get_param_importances(alone, evaluator=PedAnovaImportanceEvaluator())
        rows += [{"objective": objective, "key": key, "importance": share} for key, share in shares.items()]
    return rows


def study_of_one_objective(trials: Iterable[FrozenTrial], number: int, direction: StudyDirection) -> optuna.Study:
    """Return a study with one of the objectives: of a target function, Optuna does not know the direction."""
    study = optuna.create_study(direction=direction)
    study.add_trials(
        optuna.create_trial(
            value=trial.values[number],
            params=trial.params,
            distributions=trial.distributions,
            constraints=trial.constraints,
        )
        for trial in trials
    )
    return study
