"""Results of a study's final trainings on the test volumes, with seeds that had no part in the selection."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import optuna
from numpy.typing import NDArray
from optuna.trial import FrozenTrial, TrialState

from armscan.errors import StudyError
from armscan.stats.bootstrap import Estimate
from armscan.stats.on_plane import limits_among
from armscan.stats.paired import mean_over_seeds, of_subjects
from armscan.sweeps.scheduling.state import TEST_PREFIX
from armscan.sweeps.storage.attribute_names import EPISODES, FINAL_SEED, FINALIST, FIXED, METRICS, SUBJECTS
from armscan.sweeps.study.candidates import name_of
from armscan.training import TEST, Evaluation, MetricEstimates, ResultTable
from armscan.training.baselines import RANDOM
from armscan.training.episode_results import subject_of_volumes
from armscan.training.headline import beside_random
from armscan.training.metric_display import STEPS, bounds_of
from armscan.training.metrics import NOT_STARTED_SOLVED
from armscan.training.result_table import with_baselines

OF_VOLUME = re.compile(r"test/volume/(.+)/([^/]+)")


@dataclass(frozen=True)
class ConfigResult:
    """Final evaluation of one configuration.

    Args:
        number: Number of the trial that found the configuration, or `CONTROL`.
        figures: Metrics over all final trainings, with their intervals.
        baselines: Metrics of the baselines on the same volumes, by their names.
    """

    number: int
    figures: MetricEstimates
    baselines: Mapping[str, MetricEstimates]


def values_text(trial: FrozenTrial, objectives: Iterable[str]) -> str:
    """Return the values of a trial with the names of the objectives, as a string."""
    return ", ".join(f"{name} {value:.4g}" for name, value in zip(objectives, trial.values, strict=True))


def final_table(results: Sequence[ConfigResult]) -> ResultTable:
    """Return the table of a study's result, with a row for each configuration and each baseline."""
    figures = {name_of(result.number): result.figures for result in results}
    return ResultTable(with_baselines(figures, {name_of(each.number): each.baselines for each in results}))


def final_results(trials: Sequence[FrozenTrial]) -> list[ConfigResult]:
    """Return the final evaluation of each configuration, over all episodes of all its trainings.

    The intervals resample seeds and subjects; all drawn seeds share the drawn subjects. Trials without
    stored episodes have intervals from the means of seeds and subjects.

    Args:
        trials: Trials of the final evaluation; unfinished ones are left out.
    """
    of_number: dict[int, list[FrozenTrial]] = {}
    for trial in trials:
        if trial.state == TrialState.COMPLETE:
            of_number.setdefault(int(trial.user_attrs[FINALIST]), []).append(trial)
    return [_config_result(number, of_seeds) for number, of_seeds in of_number.items()]


def _config_result(number: int, of_seeds: Sequence[FrozenTrial]) -> ConfigResult:
    kept = [_episodes(trial) for trial in of_seeds]
    if not all(kept):
        return ConfigResult(number, _of_means(of_seeds), {})
    seeds = [trial.user_attrs[FINAL_SEED] for trial in of_seeds]
    figures = MetricEstimates.of_trainings(dict(zip(seeds, (each[TEST] for each in kept), strict=True)))
    # Baselines do not depend on the training: they are the same for each seed.
    baselines = {name: MetricEstimates.of(each) for name, each in kept[0].items() if name != TEST}
    return ConfigResult(number, beside_random(figures, [each[TEST] for each in kept], kept[0].get(RANDOM)), baselines)


def _episodes(trial: FrozenTrial) -> dict[str, Evaluation]:
    kept = trial.system_attrs.get(EPISODES, {})
    try:
        found = {name: Evaluation.of_columns(each["episodes"], each["on_plane"]) for name, each in kept.items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise StudyError(f"final training {trial.number}: its {EPISODES} in the storage are damaged") from error
    if found and (TEST not in found or not found[TEST].episodes):
        raise StudyError(f"final training {trial.number}: its {EPISODES} in the storage hold none on the {TEST}")
    return found


def _of_means(trials: Sequence[FrozenTrial]) -> MetricEstimates:
    """Return the means of the metrics that all seeds have, with intervals for other seeds and subjects."""
    of_seeds, subject_of = [trial.user_attrs[METRICS] for trial in trials], subjects_of(trials)
    common = set.intersection(*map(set, of_seeds))
    of_seeds = [{name: value for name, value in metrics.items() if name in common} for metrics in of_seeds]
    names = [name for name in of_seeds[0] if name.startswith(TEST_PREFIX) and not OF_VOLUME.fullmatch(name)]
    means = {name.removeprefix(TEST_PREFIX): _mean_of(name, of_seeds, subject_of) for name in names}
    volumes = {match[1] for name in common if (match := OF_VOLUME.fullmatch(name))}
    n_subjects = len({subject_of.get(volume, volume) for volume in volumes})
    return MetricEstimates(len(of_seeds), len(volumes), n_subjects, 0, 0, means, limits_among(means))


def _mean_of(name: str, of_seeds: Sequence[Mapping[str, float]], subject_of: Mapping[str, str]) -> Estimate:
    volumes, scores = scores_of(name, of_seeds)
    found = mean_over_seeds(of_subjects(scores, [subject_of.get(volume, volume) for volume in volumes]))
    # Equal scores do not say how others would differ.
    return found.if_wide


def bounds_in(search: optuna.Study, metric: str) -> tuple[float, float]:
    """Return the lowest and highest value of a metric in a study; an episode has at most `env.max_steps`, if fixed."""
    least, most = bounds_of(metric)
    is_in_steps = metric.removesuffix(NOT_STARTED_SOLVED) in STEPS
    return least, search.user_attrs[FIXED].get("env.max_steps", most) if is_in_steps else most


def subjects_of(trials: Sequence[FrozenTrial]) -> dict[str, str]:
    """Return the subject of each test volume; empty for older trials, which stored neither episodes nor subjects."""
    kept = [trial.system_attrs.get(SUBJECTS, {}) for trial in trials]
    if not all(isinstance(each, dict) and all(isinstance(name, str) for name in each.values()) for each in kept):
        raise StudyError(f"the {SUBJECTS} of a final training in the storage are damaged")
    played = subject_of_volumes(each[TEST] for trial in trials if (each := _episodes(trial)))
    return {volume: subject for each in (*kept, played) for volume, subject in each.items()}


def scores_of(name: str, of_seeds: Sequence[Mapping[str, float]]) -> tuple[list[str], NDArray[np.float64]]:
    """Return the test volumes and a metric, shape (seeds, volumes): those of all trainings; all together if unknown."""
    metric = name.removeprefix(TEST_PREFIX)
    common = set.intersection(*map(set, of_seeds))
    # A volume may have been added while the study was interrupted.
    found = {match[1]: key for key in of_seeds[0] if (match := OF_VOLUME.fullmatch(key)) and match[2] == metric}
    found = {volume: key for volume, key in found.items() if key in common} if found else {"all": name}
    return [*found], np.array([[metrics[key] for key in found.values()] for metrics in of_seeds])
