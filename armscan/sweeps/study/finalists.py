"""The best configurations of a study, and their final trainings with seeds that did not choose them."""

from __future__ import annotations

import json
from itertools import product

import optuna
from optuna.trial import FrozenTrial, TrialState

from armscan.config.legacy import renamed
from armscan.sweeps.scheduling.state import FINAL_SEED, FINALIST
from armscan.sweeps.storage.storage import Storage
from armscan.sweeps.study.settings import FIRST_SEED_ABOVE, StudySettings


def best_trials(study: optuna.Study, n_best: int) -> list[FrozenTrial]:
    """Return the best trials of a study, each with other values, the best first.

    With several objectives these are the ones that no other is better than in all of them, by the first objective.
    """
    several = len(study.directions) > 1
    trials = study.best_trials if several else study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
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
        settings: those of the study.
        search: the study in which configurations are searched.
        final: the study of the final trainings.
    """
    trials = final.get_trials(deepcopy=False)
    there = {(trial.user_attrs[FINALIST], trial.user_attrs[FINAL_SEED]) for trial in trials}
    # None of these seeds was a search trial run with.
    first = max(settings.seeds) + FIRST_SEED_ABOVE
    wanted = product(best_trials(search, settings.final_eval.top_k), range(first, first + settings.final_eval.n_seeds))
    return [(trial, seed) for trial, seed in wanted if (trial.number, seed) not in there]
