"""What a study has found: its best configurations, trained again with seeds that did not choose them, and judged."""

from __future__ import annotations

import json

import optuna
from optuna.trial import FrozenTrial, Trial, TrialState

from armscan.sweeps.settings import FIRST_SEED_ABOVE, StudySettings
from armscan.sweeps.storage import Storage
from armscan.sweeps.tally import JUDGED, JUDGED_SEED


def judging_seeds(settings: StudySettings) -> tuple[int, ...]:
    """Returns the seeds of the trainings that judge, none of which a trial was run with."""
    first = max(settings.seeds) + FIRST_SEED_ABOVE
    return tuple(range(first, first + settings.judging.seeds))


def best_trials(study: optuna.Study, n_best: int) -> list[FrozenTrial]:
    """Returns the best trials of a study, each with other values, the best first.

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


def make_judging_study(storage: Storage, settings: StudySettings, searched: optuna.Study) -> optuna.Study:
    """Makes the study of the trainings that judge, one for each of the best configurations and seeds.

    Where it exists, trainings are added for configurations that have become the best since.
    """

    def made() -> optuna.Study:
        study = optuna.create_study(study_name=settings.judged_name, storage=storage.optuna, load_if_exists=True)
        for trial, seed in lacking(settings, searched, study):
            study.enqueue_trial(trial.params, user_attrs={JUDGED: trial.number, JUDGED_SEED: seed})
        return study

    return storage.alone(made)


def lacking(
    settings: StudySettings, searched: optuna.Study, judging: optuna.Study | None
) -> list[tuple[FrozenTrial, int]]:
    """Returns which trials have no training yet that judges them, and with which seeds.

    Args:
        settings: of the study.
        searched: the study.
        judging: that of the trainings that judge, None where it has not been made.
    """
    trials = judging.get_trials(deepcopy=False) if judging is not None else []
    there = {(trial.user_attrs[JUDGED], trial.user_attrs[JUDGED_SEED]) for trial in trials}
    wanted = [
        (trial, seed) for trial in best_trials(searched, settings.judging.best) for seed in judging_seeds(settings)
    ]
    return [(trial, seed) for trial, seed in wanted if (trial.number, seed) not in there]


def seed_of_judged(trial: Trial) -> tuple[int, ...]:
    """Returns the one seed that a training which judges is run with."""
    return (int(trial.user_attrs[JUDGED_SEED]),)
