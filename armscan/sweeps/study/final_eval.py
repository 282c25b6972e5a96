"""The final evaluation of a study: which trainings are missing, which configuration is selected, which seeds test it.

All of it is derived from the storage. The candidates race on the validation volumes; only the chosen one and the
control are evaluated on the test volumes, with other seeds.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import takewhile
from statistics import fmean

import optuna
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from armscan.config.legacy import renamed
from armscan.sweeps.scheduling.claim import PlannedTrial
from armscan.sweeps.scheduling.population import searched_values
from armscan.sweeps.scheduling.race import MAX_SEEDS_FACTOR, Race, Scores, budget, race
from armscan.sweeps.scheduling.state import CONTROL
from armscan.sweeps.space.parameter import Value
from armscan.sweeps.storage.attribute_names import (
    DROPPED,
    FIXED,
    METRICS,
    OF_CONFIG,
    RESET_FAILURES,
    RETRIED,
)
from armscan.sweeps.study.candidates import attributes_of, settings_of, training_of
from armscan.sweeps.study.constraints import Constraint
from armscan.sweeps.study.fixed_config import CONSTRAINTS
from armscan.sweeps.study.settings import (
    SELECTION_SEEDS_ABOVE,
    TEST_SEEDS_ABOVE,
    FinalEvalSettings,
)
from armscan.sweeps.study.study import best_trials
from armscan.utils.files import sha256

ENDED_WITHOUT_SCORE = (TrialState.FAIL, TrialState.PRUNED)


@dataclass(frozen=True)
class FinalEvaluation:
    """The final evaluation of a study, in its storage.

    Args:
        settings: Its settings.
        search_seed: The largest seed of the search.
        control: Values of the control by the searched keys; None if they do not lie in the space.
        search: The study of the search.
        selection: The study of the trainings that choose a configuration.
        test: The study of the trainings on the test volumes.
        config_sha256: Checksum of the configuration that this process trains with; see `config_sha256_of`.
    """

    settings: FinalEvalSettings
    search_seed: int
    control: Mapping[str, Value] | None
    search: optuna.Study
    selection: optuna.Study
    test: optuna.Study
    config_sha256: str

    @property
    def selection_seeds(self) -> range:
        """The seeds of the selection, as many as one configuration may get; the search has used none of them."""
        first = self.search_seed + SELECTION_SEEDS_ABOVE
        return range(first, first + MAX_SEEDS_FACTOR * self.settings.mean_seeds)

    @property
    def test_seeds(self) -> range:
        """The seeds of the test; neither the search nor the selection has used any of them."""
        first = self.search_seed + TEST_SEEDS_ABOVE
        return range(first, first + self.settings.test_seeds)

    @property
    def sign(self) -> float:
        """Factor that makes higher values of the first objective better."""
        return -1.0 if self.search.directions[0] == StudyDirection.MINIMIZE else 1.0

    def contenders(self) -> list[int]:
        """Return the control and the numbers of the candidates, the best trials; nothing if no trial has finished."""
        best = best_trials(self.search, self.settings.top_k + 1)
        # A trial with the values of the control is the control, even if taken from another study or a preset.
        others = [trial.number for trial in best if renamed(searched_values(trial)) != self.control]
        # First, so that the control wins a tie.
        return [CONTROL, *others[: self.settings.top_k]] if best and self.settings.top_k else []

    def scores(self) -> dict[int, dict[int, float]]:
        """Return the score of each ended training of the selection, by contender and seed; NaN if it failed."""
        scores: dict[int, dict[int, float]] = {number: {} for number in self.contenders()}
        for trial in self._counted_trials(self.selection):
            number, seed = training_of(trial)
            if number not in scores:
                continue
            if trial.state == TrialState.COMPLETE:
                scores[number][seed] = self.sign * trial.values[0]
            elif _has_no_score(trial):
                scores[number].setdefault(seed, math.nan)
        return scores

    def race(self, scores: Scores | None = None) -> Race:
        """Return the state of the selection's race, from which those that violate a constraint are withdrawn.

        They are withdrawn after the first round. If all violate one, all race.

        Args:
            scores: Result of `scores`. Default: None, the current scores.
        """
        scores, settings = self.scores() if scores is None else scores, self.settings
        seeds, first_round = self.selection_seeds, set(self.selection_seeds[: settings.min_seeds])
        run = partial(race, seeds=seeds, min_seeds=settings.min_seeds, mean_seeds=settings.mean_seeds)
        violated = self.violated()
        violating = {number: of for number, of in scores.items() if number in violated and of.keys() >= first_round}
        if not violating or len(violating) == len(scores):
            return run(scores)
        withdrawn = {}
        for number, of in violating.items():
            # Over all of its trainings, as its constraints are.
            n_seeds = len([*takewhile(of.__contains__, seeds)])
            standing = race({number: of}, seeds, min_seeds=n_seeds, mean_seeds=n_seeds).standings[number]
            withdrawn[number] = replace(standing, is_withdrawn=True)
        found = run({number: of for number, of in scores.items() if number not in violating})
        standings = {**withdrawn, **found.standings}
        return replace(found, standings={number: standings[number] for number in scores})

    def violated(self) -> dict[int, list[str]]:
        """Return the constraints that configurations violate on average over their trainings of the race, if any."""
        stored = self.search.user_attrs.get(FIXED, {}).get(CONSTRAINTS)
        constraints = [Constraint.read(each) for each in stored] if isinstance(stored, list) else []
        metrics: dict[int, list[Mapping[str, float]]] = defaultdict(list)
        for trial in self._counted_trials(self.selection) if constraints else ():
            if trial.state == TrialState.COMPLETE:
                metrics[training_of(trial)[0]].append(trial.user_attrs.get(METRICS, {}))
        violated = {
            number: [
                str(each)
                for each in constraints
                if each.violation({each.metric: fmean(one.get(each.metric, math.nan) for one in of_number)}) > 0
            ]
            for number, of_number in metrics.items()
        }
        return {number: each for number, each in violated.items() if each}

    def missing_of_selection(self) -> list[PlannedTrial]:
        """Return the trainings that the selection needs next and no worker has begun."""
        return self._planned(self.race().missing, self.selection)

    @property
    def has_begun_all(self) -> bool:
        """Whether the selection has ended, with or without a choice, and all trainings of the test have begun."""
        return self.race().is_over and not self.missing_of_test()

    def missing_of_test(self) -> list[PlannedTrial]:
        """Return the trainings of the test that no worker has begun; during the selection, those of the control.

        The control is always tested, so idle workers train it before the race ends.
        """
        return self._planned(self.trainings_of_test(self.race()), self.test)

    def trainings_of_test(self, race: Race) -> list[tuple[int, int]]:
        """Return the trainings of the test, as far as they are known: pairs of a configuration and a seed."""
        return [(number, seed) for seed in self.test_seeds for number in to_test(race)]

    @property
    def n_untested(self) -> int:
        """Number of trainings of the test, as far as they are known, that have not ended."""
        ended = {
            training_of(trial)
            for trial in self._counted_trials(self.test)
            if trial.state.is_finished() and RETRIED not in trial.user_attrs
        }
        return len(set(self.trainings_of_test(self.race())) - ended)

    def tested(self) -> dict[tuple[int, int], FrozenTrial]:
        """Return the complete trainings of the test, by configuration and seed."""
        counted = self._counted_trials(self.test)
        return {training_of(trial): trial for trial in counted if trial.state == TrialState.COMPLETE}

    def blocked(self) -> list[str]:
        """Return the names of the studies that failed trainings block.

        They block the selection if it has no choice, and the test if it lacks a seed.
        """
        race = self.race()
        wanted, ended = self.trainings_of_test(race), filter(_has_no_score, self._counted_trials(self.test))
        is_blocked = {
            self.selection.study_name: race.is_over and race.chosen is None,
            self.test.study_name: any(training_of(trial) in wanted for trial in ended),
        }
        return [name for name in is_blocked if is_blocked[name]]

    def _planned(self, trainings: Iterable[tuple[int, int]], study: optuna.Study) -> list[PlannedTrial]:
        # The retry of an attempt counts for itself: it may have failed, and a later start ignores that.
        begun = {training_of(trial) for trial in self._counted_trials(study) if RETRIED not in trial.user_attrs}
        searched = self.search.get_trials(deepcopy=False)
        # A command with another configuration has taken over the study.
        if config_sha256_of(self.search) != self.config_sha256:
            return []
        shared = {OF_CONFIG: self.config_sha256}
        return [
            PlannedTrial(settings_of(searched, number), attributes_of(searched, number, seed) | shared)
            for number, seed in trainings
            if (number, seed) not in begun
        ]

    def unwanted_of_selection(self, waiting: Sequence[FrozenTrial]) -> list[FrozenTrial]:
        """Return the waiting trainings of the selection that it no longer needs; see `TrialScheduler`."""
        return self._unwanted(waiting, self.contenders() if waiting else ())

    def unwanted_of_test(self, waiting: Sequence[FrozenTrial]) -> list[FrozenTrial]:
        """Return the waiting trainings of the test that it no longer needs; see `TrialScheduler`."""
        return self._unwanted(waiting, to_test(self.race()) if waiting else ())

    def _unwanted(self, waiting: Sequence[FrozenTrial], wanted: Collection[int]) -> list[FrozenTrial]:
        return [trial for trial in waiting if not self.is_current(trial) or training_of(trial)[0] not in wanted]

    def is_current(self, trial: FrozenTrial) -> bool:
        """Return whether a final training has the study's configuration; without a checksum, it counts as if it had."""
        return bool(trial.user_attrs.get(OF_CONFIG, self.config_sha256) == self.config_sha256)

    def _counted_trials(self, study: optuna.Study) -> list[FrozenTrial]:
        """Return the trials of a study that count.

        Not those of an earlier configuration of the study, failed ones that a later start ignores, nor waiting ones
        that another configuration dropped: all are run again.
        """
        ignored = study.user_attrs.get(RESET_FAILURES, ())
        trials = [trial for trial in study.get_trials(deepcopy=False) if DROPPED not in trial.user_attrs]
        return [trial for trial in trials if trial.number not in ignored and self.is_current(trial)]


def _has_no_score(trial: FrozenTrial) -> bool:
    return trial.state in ENDED_WITHOUT_SCORE and RETRIED not in trial.user_attrs


def config_sha256_of(search: optuna.Study) -> str:
    """Return the checksum of a study's configuration without the searched values."""
    return sha256(json.dumps(search.user_attrs.get(FIXED), sort_keys=True).encode())


def to_test(race: Race) -> list[int]:
    """Return the configurations to evaluate on the test volumes: the chosen one and the control.

    The control alone while the race continues; none if nothing was chosen.
    """
    if race.chosen is None:
        return [] if race.is_over else [CONTROL]
    return list(dict.fromkeys((race.chosen, CONTROL)))


def n_trainings(settings: FinalEvalSettings, n_trials: int) -> tuple[int, int]:
    """Return a lower and an upper bound on the number of trainings of a final evaluation in which none fails.

    The lower bound assumes that the control is far ahead as soon as it has enough seeds.

    Args:
        settings: Settings of the final evaluation.
        n_trials: Number of trials of the search, which may be fewer than its candidates.
    """
    n_candidates = min(settings.top_k, n_trials)
    if not n_candidates:
        return 0, 0
    fewest, most = budget(n_candidates + 1, min_seeds=settings.min_seeds, mean_seeds=settings.mean_seeds)
    return fewest + settings.test_seeds, most + 2 * settings.test_seeds
