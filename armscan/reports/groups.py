"""Groups of trainings that differ only in their seed and their fold, and their names."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from armscan.config.defaults import ADDED, FOLD, NOT_COMPARED
from armscan.config.own_code import mixed_modules
from armscan.config.task import is_under, rules_in
from armscan.reports.load import TrackedTraining

LEFT_OUT = (*NOT_COMPARED, "data.cache_dir", FOLD)
SEED_IN_NAME = re.compile(r"(-fold\d+)?-seed\d+$")
MAX_LABEL_CHARS = 72
# The sections that precede a key.
SECTIONS = re.compile(r"[\w.]+\.(?=\w+=)")
# A number with more digits than a label has room for.
LONG_NUMBER = re.compile(r"(?<==)\d+\.\d{5,}(e[-+]?\d+)?")


@dataclass(frozen=True)
class Group:
    """Trainings with the same configuration.

    Args:
        number: Number of the group, from 1.
        name: Keys and values by which it differs from the other groups.
        label: Number and name, short enough for a legend.
        trainings: Its trainings, each with its own seed or test fold.
    """

    number: int
    name: str
    label: str
    trainings: tuple[TrackedTraining, ...]

    @property
    def n_seeds(self) -> int:
        """Number of seeds; all folds of a seed count once."""
        return len({training.seed_key for training in self.trainings})

    @property
    def n_folds(self) -> int:
        """Number of folds of a cross-validation that its trainings were tested on."""
        return len({training.fold for training in self.trainings if training.fold is not None})

    @property
    def tested(self) -> list[TrackedTraining]:
        """Trainings with a final evaluation, of the folds that all seeds were tested on."""
        return of_common_folds(training for training in self.trainings if training.evaluation is not None)

    @property
    def has_same_volumes(self) -> bool:
        """Whether all of its trainings had the same volumes, or those of their fold, as far as that is known."""
        of_fold = {training.fold: training.volumes for training in self.trainings if training.volumes is not None}
        return all(training.volumes in (None, of_fold.get(training.fold)) for training in self.trainings)

    @property
    def mixed_modules(self) -> list[str]:
        """Modules of own classes of which its trainings have loaded different versions."""
        return mixed_modules(training.own_code for training in self.trainings)

    @property
    def commits(self) -> set[str]:
        """Commits of armscan that its trainings ran, as far as they are known."""
        return {training.commit for training in self.trainings if training.commit is not None}

    @property
    def title(self) -> str:
        """Number and name."""
        return f"{self.number}. {self.name}"


def group_trainings(trainings: Sequence[TrackedTraining]) -> tuple[list[Group], list[TrackedTraining]]:
    """Return the groups in the order of their first trainings, and the trainings that are left out.

    Of several trainings with the same configuration, seed and fold only one counts, because the others add nothing new:
    one that has run to its end if there is any, and of these the last one started.
    """
    of_key: dict[tuple[tuple[str, str], ...], list[TrackedTraining]] = {}
    trainings = _with_same_limits(trainings)
    for training in trainings:
        of_key.setdefault(tuple(sorted(_compared(training.params).items())), []).append(training)
    kept = [_one_for_each_seed(each) for each in of_key.values()]
    groups = []
    for number, (name, each) in enumerate(zip(_names([each[0] for each in kept]), kept, strict=True), start=1):
        groups.append(Group(number, name, f"{number}. {_shortened(name)}", tuple(each)))
    counted = {training.run_id for group in groups for training in group.trainings}
    return groups, [training for training in trainings if training.run_id not in counted]


def _with_same_limits(trainings: Sequence[TrackedTraining]) -> list[TrackedTraining]:
    """Return the trainings with the on-plane limits of the first evaluation applied to all of them."""
    limits = next((each.evaluation.on_plane for each in trainings if each.evaluation is not None), ())
    return [
        replace(
            each,
            evaluation=each.evaluation and replace(each.evaluation, on_plane=limits),
            baselines={name: replace(played, on_plane=limits) for name, played in each.baselines.items()},
        )
        for each in trainings
    ]


def of_common_folds(trainings: Iterable[TrackedTraining]) -> list[TrackedTraining]:
    """Return the trainings of the folds that all seeds have: otherwise wrists of the other folds would count less."""
    trainings, of_seeds = list(trainings), defaultdict(set)
    for training in trainings:
        of_seeds[training.seed_key].add(training.fold)
    common = set.intersection(*of_seeds.values()) if of_seeds else set()
    return [training for training in trainings if training.fold in common]


def differing_rules(groups: Sequence[Group]) -> list[str]:
    """Return the keys, apart from the agent's and its observations', in which the groups' episodes differ."""
    return _differing([rules_in(_compared(group.trainings[0].params)) for group in groups])


def _one_for_each_seed(trainings: Iterable[TrackedTraining]) -> list[TrackedTraining]:
    of_seed: dict[str, TrackedTraining] = {}
    for training in sorted(trainings, key=lambda each: (each.is_whole, each.started_ms)):
        of_seed[training.label] = training
    return sorted(of_seed.values(), key=lambda each: (len(each.label), each.label))


def _compared(params: Mapping[str, str]) -> dict[str, str]:
    kept = {key: value for key, value in params.items() if not is_under(key, LEFT_OUT)}
    return {key: value for key, value in kept.items() if key not in ADDED or value != str(None)}


def _differing(of_groups: Sequence[Mapping[str, str]]) -> list[str]:
    """Return the keys whose values differ; of several with one name and the same values, as by reference, the first."""
    keys = sorted({key for each in of_groups for key in each}, key=lambda key: (key.count("."), key))
    first: dict[tuple[str, tuple[str | None, ...]], str] = {}
    for key in keys:
        values = tuple(each.get(key) for each in of_groups)
        if len(set(values)) > 1:
            first.setdefault((key.rpartition(".")[2], values), key)
    return list(first.values())


def _names(firsts: Sequence[TrackedTraining]) -> list[str]:
    """Return the names of groups, by the first training of each."""
    params = [_compared(training.params) for training in firsts]
    keys = _differing(params)
    chosen = [each for each in firsts[0].choices if len({training.choices.get(each) for training in firsts}) > 1]
    names = []
    for number, training in enumerate(firsts):
        parts = [f"{each}={training.choices.get(each, '?')}" for each in chosen]
        for key in keys:
            section = key.partition(".")[0]
            # The name of a choice implies its values, except for those that were overridden, or in which groups with
            # this choice differ.
            alike = [
                params[other].get(key)
                for other, each in enumerate(firsts)
                if section not in chosen or each.choices.get(section) == training.choices.get(section)
            ]
            if key in params[number] and (len(set(alike)) > 1 or key in training.overridden):
                parts.append(f"{key}={params[number][key]}")
        names.append(", ".join(parts) or SEED_IN_NAME.sub("", training.name))
    return _distinct(names)


def _shortened(name: str) -> str:
    """Return a name with the last part of each key and four digits of long numbers, cut if it is still too long."""
    short = LONG_NUMBER.sub(lambda number: f"{float(number[0]):.4g}", SECTIONS.sub("", name))
    return short if len(short) <= MAX_LABEL_CHARS else f"{short[: MAX_LABEL_CHARS - 1]}…"


def _distinct(names: Sequence[str]) -> list[str]:
    """Return the names, with a number for those that occur several times."""
    counts, seen, distinct = Counter(names), Counter[str](), []
    for name in names:
        seen[name] += 1
        distinct.append(f"{name} ({seen[name]})" if counts[name] > 1 else name)
    return distinct
