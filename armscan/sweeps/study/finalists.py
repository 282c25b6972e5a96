"""The best configurations of a study, and their final trainings with seeds that did not choose them."""

from __future__ import annotations

import json

import optuna
from optuna.trial import FrozenTrial, Trial, TrialState

from armscan.config.legacy import renamed
from armscan.sweeps.scheduling.state import FINAL_SEED, FINALIST
from armscan.sweeps.storage.storage import Storage
from armscan.sweeps.study.settings import FIRST_SEED_ABOVE, StudySettings


def final_seeds(settings: StudySettings) -> tuple[int, ...]:
    """Return the seeds of the final trainings, none of which a search trial was run with."""
    first = max(settings.seeds) + FIRST_SEED_ABOVE
    return tuple(range(first, first + settings.final_eval.n_seeds))


def best_trials(study: optuna.Study, n_best: int) -> list[FrozenTrial]:
    """Return the best trials of a study, each with other values, the best first.

    With several objectives these are the ones that no other is better than in all of them, by the first objective.
    """
    trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len(study.directions) > 1:
        trials = study.best_trials
    is_down = study.directions[0] == optuna.study.StudyDirection.MINIMIZE
    ranked = sorted(trials, key=lambda trial: (trial.values[0] if is_down else -trial.values[0], trial.number))
    different: dict[str, FrozenTrial] = {}
    for trial in ranked:
        different.setdefault(json.dumps(trial.params, sort_keys=True), trial)
    return list(different.values())[:n_best]


def enqueue_final_trials(storage: Storage, settings: StudySettings, search: optuna.Study, final: optuna.Study) -> None:
    """Enqueue the final trainings that are missing, one for each of the best configurations and seeds."""

    def enqueue() -> None:
        for trial, seed in missing_final_trials(settings, search, final):
            final.enqueue_trial(renamed(trial.params), user_attrs={FINALIST: trial.number, FINAL_SEED: seed})

    storage.exclusive(enqueue)


def missing_final_trials(
    settings: StudySettings, search: optuna.Study, final: optuna.Study
) -> list[tuple[FrozenTrial, int]]:
    """Return the best trials with each seed for which there is no final training yet.

    Args:
        settings: of the study.
        search: the study.
        final: the study of the final trainings.
    """
    trials = final.get_trials(deepcopy=False)
    there = {(trial.user_attrs[FINALIST], trial.user_attrs[FINAL_SEED]) for trial in trials}
    wanted = [
        (trial, seed) for trial in best_trials(search, settings.final_eval.top_k) for seed in final_seeds(settings)
    ]
    return [(trial, seed) for trial, seed in wanted if (trial.number, seed) not in there]


def final_seed_of(trial: Trial) -> tuple[int, ...]:
    """Return the one seed that a final training is run with."""
    return (int(trial.user_attrs[FINAL_SEED]),)
