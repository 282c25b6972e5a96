"""The result of a study: the chosen configuration compared with the control on the test volumes, seed by seed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from optuna.trial import TrialState

from armscan.experiment.results import volume_notes
from armscan.sweeps.results.difference import Difference, differences_of
from armscan.sweeps.results.final_results import ConfigResult, final_results
from armscan.sweeps.results.notes import code_notes, notes_on
from armscan.sweeps.scheduling.state import CONTROL
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.storage.attribute_names import OF_CONFIG
from armscan.sweeps.study.candidates import name_of, settings_of, training_of
from armscan.sweeps.study.final_eval import FinalEvaluation, to_test
from armscan.training.baselines import RANDOM
from armscan.training.headline import headline
from armscan.training.metric_display import title_of
from armscan.utils.text import counted


@dataclass(frozen=True)
class StudyResult:
    """Result of a study: the chosen configuration on the test volumes, beside the control.

    Args:
        chosen: Number of the chosen trial, or `CONTROL`.
        results: Results of the chosen one and the control, as far as their trainings have finished.
        differences: Differences of the objectives and of the leading metrics; none where the control was chosen.
        n_seeds: Number of seeds that both have been trained with.
        n_planned: Number of seeds planned for both.
        others: Other trials evaluated on the test volumes, because the study continued after its end.
        settings: Overrides of the chosen one and the control, by their names; an empty string without any.
        n_untested: Number of trainings of the test that have not ended. Default: 0.
        have_others_failed: Whether a training of every other candidate failed in the race. Default: False.
        violated: Constraints of the study that configurations violated in the race. Default: none.
        n_left_out: Number of their trainings with seeds beyond `study.final_eval.test_seeds`. Default: 0.
        is_repeated: Whether trainings with an earlier configuration of the study were tested before. Default: False.
        changes: Notes on changes of the study's configuration and of armscan's code. Default: none.
    """

    chosen: int
    results: tuple[ConfigResult, ...]
    differences: tuple[Difference, ...]
    n_seeds: int
    n_planned: int
    others: tuple[int, ...]
    settings: Mapping[str, str]
    n_untested: int = 0
    have_others_failed: bool = False
    violated: Mapping[int, Sequence[str]] = field(default_factory=dict)
    n_left_out: int = 0
    is_repeated: bool = False
    changes: Sequence[str] = ()

    @property
    def notes(self) -> list[str]:
        """Notes on the result."""
        notes = [*self.changes]
        if self.n_seeds < self.n_planned:
            notes.append(f"only {self.n_seeds} of {self.n_planned} seeds have been trained to their end")
        if self.n_left_out:
            these = counted(self.n_left_out, "further training")
            notes.append(f"{these} on the test volumes, left out: study.final_eval.test_seeds is {self.n_planned}")
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
            notes.append(f"the test volumes were used before for {names}: the study went on after they had been used")
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
    def summary(self) -> str:
        """The result in a few sentences: the statement, and the chosen configuration beside random planes."""
        ours = {name_of(each.number): each for each in self.results if each.number == self.chosen}
        randoms = {name: each.baselines[RANDOM] for name, each in ours.items() if RANDOM in each.baselines}
        return f"{self.statement} {headline({name: each.figures for name, each in ours.items()}, randoms)}".strip()

    @property
    def statement(self) -> str:
        """The comparison with the control in a sentence."""
        if self.chosen == CONTROL and self.have_others_failed:
            return "The control was chosen, because trainings of all other candidates have failed."
        if self.chosen == CONTROL:
            of_them = " that satisfies all constraints" if self.violated and CONTROL not in self.violated else ""
            return (
                f"No setting{of_them} beat the control, the study's configuration without the searched values, in the "
                "selection on the validation volumes."
            )
        name = name_of(self.chosen).capitalize()
        if not self.differences and self.n_untested:
            return f"{name} was chosen; it has not been compared with the control yet."
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
        if first.direction:
            return f"{name} is {first.direction} than the control ({title_of(first.metric)})."
        return (
            f"{name} was chosen, but the test volumes do not show that it is better than the control: the interval of "
            f"the difference contains 0 ({title_of(first.metric)})."
        )


def study_result(final: FinalEvaluation) -> StudyResult | None:
    """Return the result of a study; None before a configuration is chosen."""
    race = final.race()
    if (chosen := race.chosen) is None:
        return None
    tested = final.tested()
    both = to_test(race)
    now = [tested[number, seed] for number in both for seed in final.test_seeds if (number, seed) in tested]
    seeds = [seed for seed in final.test_seeds if all((number, seed) in tested for number in both)]
    pairs = [[tested[number, seed] for seed in seeds] for number in both]
    differences = differences_of(final.search, *pairs) if seeds and chosen != CONTROL else ()
    complete = final.test.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    others = sorted({training_of(trial)[0] for trial in complete} - set(both))
    results, searched = tuple(final_results(now)), final.search.get_trials(deepcopy=False)
    of_others = [standing for number, standing in race.standings.items() if number != CONTROL]
    return StudyResult(
        chosen=chosen,
        results=results,
        differences=tuple(differences),
        n_seeds=len(seeds),
        n_planned=len(final.test_seeds),
        others=tuple(others),
        settings={name_of(each.number): " ".join(overrides_of(settings_of(searched, each.number))) for each in results},
        n_untested=final.n_untested,
        violated={number: each for number, each in final.violated().items() if number in race.standings},
        n_left_out=sum(
            final.is_current(trial)
            and OF_CONFIG in trial.user_attrs
            and training_of(trial)[0] in both
            and training_of(trial)[1] not in final.test_seeds
            for trial in complete
        ),
        # Those of the first version have no checksum, and other seeds.
        is_repeated=any(
            not final.is_current(trial)
            or (OF_CONFIG not in trial.user_attrs and training_of(trial)[1] not in final.test_seeds)
            for trial in complete
        ),
        changes=[
            *notes_on(final.search),
            *code_notes(final.selection, "the trainings of the selection"),
            *code_notes(final.test, "the trainings on the test volumes"),
        ],
        have_others_failed=bool(of_others) and all(standing.has_failed for standing in of_others),
    )
