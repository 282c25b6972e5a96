"""The final evaluation of a study: which trainings are missing, which configuration is selected, which seeds judge it.

All of it is derived from the storage. The candidates race on the validation volumes; only the chosen one and the
control are evaluated on the test volumes, with other seeds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean
from typing import Any, Self

import optuna
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState
from pydantic import Field

from armscan.config.legacy import renamed
from armscan.errors import StudyError
from armscan.sweeps.scheduling.claim import PlannedTrial
from armscan.sweeps.scheduling.population import searched_values
from armscan.sweeps.scheduling.race import MAX_SEEDS_FACTOR, Race, Scores, budget, race
from armscan.sweeps.scheduling.state import CONTROL
from armscan.sweeps.space.parameter import Value
from armscan.sweeps.storage.attribute_names import (
    FINAL_SEED,
    FINALIST,
    FIXED,
    METRICS,
    OF_CONFIG,
    RESET_FAILURES,
    RETRIED,
    SCHEDULE,
)
from armscan.sweeps.storage.attributes import FINAL_SUFFIXES, JUDGEMENT_SUFFIX, SELECTION_SUFFIX, check_trials
from armscan.sweeps.storage.storage import Storage
from armscan.sweeps.study.constraints import Constraint
from armscan.sweeps.study.settings import (
    JUDGEMENT_SEEDS_ABOVE,
    MAX_SEARCH_SEED,
    SELECTION_SEEDS_ABOVE,
    FinalEvalSettings,
    StudySettings,
)
from armscan.sweeps.study.study import CONSTRAINTS, best_trials
from armscan.utils.files import sha256
from armscan.utils.section import Section

# User attribute of the study of the selection: its settings, for reports.
FINAL_EVAL = "final_eval"
# Description of the control.
NOTHING_SEARCHED = "the study's configuration without the searched values"
ENDED_WITHOUT_SCORE = (TrialState.FAIL, TrialState.PRUNED)


class _Stored(Section):
    """Settings of a final evaluation, as the study of the selection stores them; see `FinalEvaluation`."""

    settings: FinalEvalSettings = Field(description="a section with top_k, min_seeds, mean_seeds and judge_seeds")
    search_seed: int = Field(ge=0, le=MAX_SEARCH_SEED, description="the largest seed of the search")
    control: dict[str, Value] | None = Field(default=None, description="the values of the control by their keys")


@dataclass(frozen=True)
class FinalEvaluation:
    """The final evaluation of a study, in its storage.

    Args:
        settings: Its settings.
        search_seed: The largest seed of the search.
        control: Values of the control by the searched keys; None if they do not lie in the space.
        search: The study of the search.
        selection: The study of the trainings that choose a configuration.
        judgement: The study of the trainings that judge it.
        config_sha256: Checksum of the study's configuration without the searched values, as its trainings have it here.
    """

    settings: FinalEvalSettings
    search_seed: int
    control: Mapping[str, Value] | None
    search: optuna.Study
    selection: optuna.Study
    judgement: optuna.Study
    config_sha256: str

    @classmethod
    def opened(
        cls, storage: Storage, settings: StudySettings, search: optuna.Study, control: Mapping[str, Value] | None
    ) -> Self:
        """Create the two studies, or load them.

        Args:
            storage: Storage of the study.
            settings: Settings of the whole study.
            search: Study of the search.
            control: Values of the control by the searched keys; None if they do not lie in the space.
        """

        def make(suffix: str, directions: Sequence[StudyDirection]) -> optuna.Study:
            study = storage.exclusive(
                lambda: optuna.create_study(
                    study_name=settings.name + suffix,
                    storage=storage.optuna,
                    directions=directions,
                    load_if_exists=True,
                )
            )
            check_trials(study, n_searched=len(search.get_trials(deepcopy=False)))
            return study

        selection = make(SELECTION_SUFFIX, search.directions)
        stored = {
            "settings": settings.final_eval.model_dump(),
            "search_seed": max(settings.seeds),
            "control": None if control is None else dict(control),
        }
        if selection.user_attrs.get(FINAL_EVAL) != stored:
            selection.set_user_attr(FINAL_EVAL, stored)
        judgement = make(JUDGEMENT_SUFFIX, [StudyDirection.MINIMIZE])
        return cls(
            settings.final_eval, max(settings.seeds), control, search, selection, judgement, _config_sha256(search)
        )

    @classmethod
    def stored(cls, storage: Storage, search: optuna.Study) -> Self | None:
        """Return the final evaluation of a stored study; None if none was begun, or an earlier version made it."""
        selection, judgement = (storage.study(search.study_name + suffix) for suffix in FINAL_SUFFIXES)
        if selection is None or judgement is None:
            return None
        for study in (selection, judgement):
            check_trials(study, n_searched=len(search.get_trials(deepcopy=False)))
        where, found = f"{selection.study_name}.user_attrs.{FINAL_EVAL}", selection.user_attrs.get(FINAL_EVAL)
        if not isinstance(found, Mapping):
            raise StudyError(f"{where} is {found!r}, but it must be the settings of the final evaluation")
        settings = found.get("settings")
        if isinstance(settings, Mapping) and "max_seeds" in settings:
            # Its race had other rules.
            return None
        kept = _Stored.read(where, found)
        return cls(kept.settings, kept.search_seed, kept.control, search, selection, judgement, _config_sha256(search))

    @property
    def selection_seeds(self) -> range:
        """The seeds of the selection, as many as one configuration may get; the search has not used one."""
        first = self.search_seed + SELECTION_SEEDS_ABOVE
        return range(first, first + MAX_SEEDS_FACTOR * self.settings.mean_seeds)

    @property
    def judge_seeds(self) -> range:
        """The seeds of the judgement; neither the search nor the selection has used one."""
        first = self.search_seed + JUDGEMENT_SEEDS_ABOVE
        return range(first, first + self.settings.judge_seeds)

    @property
    def sign(self) -> float:
        """Factor that makes higher values of the first objective better."""
        return -1.0 if self.search.directions[0] == StudyDirection.MINIMIZE else 1.0

    def candidates(self) -> list[int]:
        """Return the control and the numbers of the best trials; nothing if no trial has finished."""
        best = best_trials(self.search, self.settings.top_k + 1)
        # A trial with the values of the control is the control, even if taken from another study or a preset.
        others = [trial.number for trial in best if renamed(searched_values(trial)) != self.control]
        # First, so that the control wins a tie.
        return [CONTROL, *others[: self.settings.top_k]] if best and self.settings.top_k else []

    def scores(self) -> dict[int, dict[int, float]]:
        """Return the score of each ended training of the selection, by candidate and seed; NaN if it failed."""
        scores: dict[int, dict[int, float]] = {number: {} for number in self.candidates()}
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
        """Return the state of the selection's race; a control that violates a constraint leaves it early.

        Args:
            scores: Result of `scores`. Default: None, the current scores.
        """
        scores, settings = self.scores() if scores is None else scores, self.settings
        run = partial(race, seeds=self.selection_seeds, min_seeds=settings.min_seeds)
        others = {number: scores[number] for number in scores if number != CONTROL}
        has_ended_round = scores.get(CONTROL, {}).keys() >= set(self.selection_seeds[: settings.min_seeds])
        if others and has_ended_round and self.violated_by_control():
            found = run(others, mean_seeds=settings.mean_seeds)
            alone = run({CONTROL: scores[CONTROL]}, mean_seeds=settings.min_seeds)
            gone = {CONTROL: replace(alone.standings[CONTROL], has_left=True)}
            return replace(found, standings={**gone, **found.standings})
        return run(scores, mean_seeds=settings.mean_seeds)

    def violated_by_control(self) -> list[str]:
        """Return the constraints of the study that the control violates, on average over its trainings of the race."""
        metrics = [
            trial.user_attrs.get(METRICS, {})
            for trial in self._counted_trials(self.selection)
            if trial.state == TrialState.COMPLETE and training_of(trial)[0] == CONTROL
        ]
        stored = self.search.user_attrs.get(FIXED, {}).get(CONSTRAINTS)
        return [
            str(each)
            for each in map(Constraint.read, stored if isinstance(stored, list) else ())
            if metrics and each.violation({each.metric: fmean(of.get(each.metric, math.nan) for of in metrics)}) > 0
        ]

    def missing_of_selection(self) -> list[PlannedTrial]:
        """Return the trainings that the selection needs next and no worker has begun."""
        return self._planned(self.race().missing, self.selection)

    @property
    def is_over(self) -> bool:
        """Whether the selection has ended, with or without a choice, and all trainings of the judgement have begun."""
        return self.race().is_over and not self.missing_of_judgement()

    def missing_of_judgement(self) -> list[PlannedTrial]:
        """Return the trainings of the judgement that no worker has begun; during the selection, those of the control.

        The control is always judged, so idle workers train it before the race ends.
        """
        return self._planned(self.trainings_of_judgement(self.race()), self.judgement)

    def trainings_of_judgement(self, race: Race) -> list[tuple[int, int]]:
        """Return the trainings of the judgement, as far as they are known: pairs of a configuration and a seed."""
        return [(number, seed) for seed in self.judge_seeds for number in to_judge(race)]

    @property
    def n_unjudged(self) -> int:
        """Number of trainings of the judgement, as far as they are known, that have not ended."""
        ended = {
            training_of(trial)
            for trial in self._counted_trials(self.judgement)
            if trial.state.is_finished() and RETRIED not in trial.user_attrs
        }
        return len(set(self.trainings_of_judgement(self.race())) - ended)

    def judged(self) -> dict[tuple[int, int], FrozenTrial]:
        """Return the complete trainings of the judgement, by configuration and seed."""
        counted = self._counted_trials(self.judgement)
        return {training_of(trial): trial for trial in counted if trial.state == TrialState.COMPLETE}

    def blocked(self) -> list[str]:
        """Return the names of the studies that failed trainings block: without a choice, or a seed of the judgement."""
        race = self.race()
        wanted, ended = self.trainings_of_judgement(race), filter(_has_no_score, self._counted_trials(self.judgement))
        is_blocked = {
            self.selection.study_name: race.is_over and race.chosen is None,
            self.judgement.study_name: any(training_of(trial) in wanted for trial in ended),
        }
        return [name for name in is_blocked if is_blocked[name]]

    def _planned(self, trainings: Iterable[tuple[int, int]], study: optuna.Study) -> list[PlannedTrial]:
        begun = set(map(training_of, self._counted_trials(study)))
        searched = self.search.get_trials(deepcopy=False)
        # A command with another configuration has taken over the study.
        if _config_sha256(self.search) != self.config_sha256:
            return []
        shared = {OF_CONFIG: self.config_sha256}
        return [
            PlannedTrial(settings_of(searched, number), _attributes(searched, number, seed) | shared)
            for number, seed in trainings
            if (number, seed) not in begun
        ]

    def is_current(self, trial: FrozenTrial) -> bool:
        """Return whether a final training has the study's configuration; without a checksum, it counts as if it had."""
        return bool(trial.user_attrs.get(OF_CONFIG, self.config_sha256) == self.config_sha256)

    def _counted_trials(self, study: optuna.Study) -> list[FrozenTrial]:
        """Return the trials of a study that count.

        Not those of an earlier configuration of the study, nor failed ones that a later start ignores: both are
        run again.
        """
        ignored = study.user_attrs.get(RESET_FAILURES, ())
        trials = study.get_trials(deepcopy=False)
        return [trial for trial in trials if trial.number not in ignored and self.is_current(trial)]


def _has_no_score(trial: FrozenTrial) -> bool:
    return trial.state in ENDED_WITHOUT_SCORE and RETRIED not in trial.user_attrs


def _config_sha256(search: optuna.Study) -> str:
    return sha256(json.dumps(search.user_attrs.get(FIXED), sort_keys=True).encode())


def to_judge(race: Race) -> list[int]:
    """Return the configurations to evaluate on the test volumes: the chosen one and the control.

    The control alone while the race continues; none if nothing was chosen.
    """
    if race.chosen is None:
        return [] if race.is_over else [CONTROL]
    return list(dict.fromkeys((race.chosen, CONTROL)))


def training_of(trial: FrozenTrial | Trial) -> tuple[int, int]:
    """Return the configuration and the seed of a final training."""
    return int(trial.user_attrs[FINALIST]), int(trial.user_attrs[FINAL_SEED])


def name_of(number: int) -> str:
    """Return the name of a configuration for users: `control`, or `trial 7`."""
    return "control" if number == CONTROL else f"trial {number}"


def key_of(number: int) -> int | str:
    """Return the name of a configuration in files: the number of its trial, or `control`."""
    return "control" if number == CONTROL else number


def settings_of(searched: Sequence[FrozenTrial], number: int) -> dict[str, Any]:
    """Return the values of a configuration by their keys; the control has none.

    Args:
        searched: Trials of the search.
        number: Number of one of them, or `CONTROL`.
    """
    return {} if number == CONTROL else renamed(searched_values(searched[number]))


def _attributes(searched: Sequence[FrozenTrial], number: int, seed: int) -> dict[str, Any]:
    schedule = [] if number == CONTROL else searched[number].user_attrs.get(SCHEDULE, [])
    return {FINALIST: number, FINAL_SEED: seed} | ({SCHEDULE: schedule} if schedule else {})


def n_trainings(settings: FinalEvalSettings) -> tuple[int, int]:
    """Return a lower and an upper bound on the number of trainings of a final evaluation in which none fails.

    The lower bound assumes that the control is far ahead as soon as it has enough seeds.
    """
    if not settings.top_k:
        return 0, 0
    fewest, most = budget(settings.top_k + 1, min_seeds=settings.min_seeds, mean_seeds=settings.mean_seeds)
    return fewest + settings.judge_seeds, most + 2 * settings.judge_seeds
