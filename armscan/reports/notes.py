"""Notes on the validity of a comparison."""

from __future__ import annotations

import html
import math
from collections.abc import Iterator, Sequence

from armscan.config.defaults import FOLDS
from armscan.errors import few
from armscan.reports.charts import Curves
from armscan.reports.groups import Group, differing_rules
from armscan.reports.load import TrackedTraining, validation_titles
from armscan.reports.significance import evaluations_by_seed
from armscan.stats.aggregation import MIN_SEEDS
from armscan.tracking.tags import OWN_CODE_TAG
from armscan.training.headline import MIN_SUBJECTS
from armscan.training.metrics import MetricEstimates
from armscan.training.splits import PARTS
from armscan.utils.run_files import ID_CHARS
from armscan.utils.text import counted
from armscan.volumes.phantom.generate import PHANTOM_NAME

# From this number of seeds on, the intervals of final figures are nearly as wide as they should be.
MANY_SEEDS = 5
PRETRAINING = "agent.pretraining_env_steps"


def notes_on(
    groups: Sequence[Group],
    left_out: Sequence[TrackedTraining],
    curves: Curves,
    reached: Sequence[MetricEstimates | None],
    *,
    has_other_volumes: bool,
) -> str:
    """Return the notes as a list, nothing if there are none.

    Args:
        groups: Groups to compare.
        left_out: Trainings that repeat another one.
        curves: Learning curves of the groups.
        reached: Final metrics of each group; None if none of its trainings was tested.
        has_other_volumes: Whether groups were tested on different volumes.
    """
    notes = [
        *_on_folds(groups),
        *_on_seeds(groups),
        *_on_subjects(groups, reached),
        *_on_pretraining(groups),
        *_on_unfinished(groups),
        *_on_missing(groups),
        *_on_curves(groups, curves),
        *_on_code(groups),
        *_on_volumes(groups),
        *_on_rules(groups, has_other_volumes=has_other_volumes),
    ]
    if left_out:
        which = ", ".join(f"{training.id} ({training.label})" for training in left_out)
        notes.append(f"Left out, because another run has the same configuration and seed: {which}.")
    return f"<ul>{''.join(f'<li>{html.escape(note)}</li>' for note in notes)}</ul>" if notes else ""


def _on_folds(groups: Sequence[Group]) -> Iterator[str]:
    for group in groups:
        folds, tested = ({each.fold for each in some} for some in (group.trainings, group.tested))
        if folds == {None}:
            continue
        planned = group.trainings[0].params[FOLDS]
        n_folds = f"{len(tested)} of {planned}" if planned.isdecimal() else str(len(tested))
        yield (
            f"Group {group.number} is a cross-validation: the figures on the test volumes are over {n_folds} folds, "
            "each volume tested on by trainings that have not seen it, and intervals draw subjects. In learning curves "
            "each fold of a seed is a line."
        )
        own = _own_volumes(group.trainings, PARTS)
        if untested := sorted(own - _own_volumes(group.tested, ["test"])):
            yield (
                f"Group {group.number}: {len(untested)} of its {len(own)} volumes were not tested on, so the figures "
                f"are without {few(untested)}."
            )
        if left_out := ", ".join(sorted(str(fold) for fold in folds - tested)):
            yield (
                f"Group {group.number}: not all seeds were tested on fold {left_out}, which is left out of the figures "
                "on the test volumes."
            )


def _own_volumes(trainings: Sequence[TrackedTraining], parts: Sequence[str]) -> set[str]:
    """Return the names of the volumes in these parts, without phantoms."""
    named = (name for each in trainings for part in parts for name in (each.volumes or {}).get(part, {}))
    return {name for name in named if not PHANTOM_NAME.fullmatch(name)}


def _on_seeds(groups: Sequence[Group]) -> Iterator[str]:
    # Seeds of a search are not tested.
    n_seeds = {group.number: len(evaluations_by_seed(group)) or group.n_seeds for group in groups}
    if single := [number for number, n in n_seeds.items() if n == 1]:
        yield (
            f"{_numbered(single, groups)}: one seed says nothing about other seeds; intervals cover wrists and "
            "episodes only."
        )
    if few := [number for number, n in n_seeds.items() if 1 < n < MANY_SEEDS]:
        yield (
            f"{_numbered(few, groups)}: with few seeds the intervals of the final figures are too narrow; those of "
            f"curves (from {MIN_SEEDS} seeds on) and of the probabilities below are not."
        )


def _on_subjects(groups: Sequence[Group], reached: Sequence[MetricEstimates | None]) -> Iterator[str]:
    tested = [(group.number, each.n_subjects) for group, each in zip(groups, reached, strict=True) if each is not None]
    if few := [number for number, n_subjects in tested if 0 < n_subjects < MIN_SUBJECTS]:
        what = f"fewer than {MIN_SUBJECTS} test subjects: the intervals are too narrow for other subjects"
        yield f"{_numbered(few, groups)}: {what}."


def _on_pretraining(groups: Sequence[Group]) -> Iterator[str]:
    for group in groups:
        n_pretraining = group.trainings[0].params.get(PRETRAINING, "")
        tested = [each for each in group.tested if not math.isnan(each.best_env_steps)]
        if not n_pretraining.isdecimal() or not tested:
            continue
        if n_pretrained := sum(each.best_env_steps <= int(n_pretraining) for each in tested):
            yield (
                f"Group {group.number}: the best weights of {n_pretrained} of {counted(len(tested), 'run')} are from "
                "the pretraining; their planes are the plane finder's, which SAC has not corrected."
            )


def _on_unfinished(groups: Sequence[Group]) -> Iterator[str]:
    unfinished = [(group, training) for group in groups for training in group.trainings if not training.is_whole]
    if unfinished:
        which = [f"{_named(group, training)}: {training.status}" for group, training in unfinished]
        yield f"Unfinished, and shown with the data so far: {'; '.join(which)}."


def _on_missing(groups: Sequence[Group]) -> Iterator[str]:
    of_files: dict[str, list[str]] = {}
    for group in groups:
        for training in group.trainings:
            # Unfinished ones have a note of their own.
            for file in training.missing if training.is_whole else ():
                of_files.setdefault(file, []).append(_named(group, training))
    for file, which in of_files.items():
        yield f"No {file} is among the artifacts of {'; '.join(which)}."


def _on_curves(groups: Sequence[Group], curves: Curves) -> Iterator[str]:
    titles = validation_titles(metric for metric, *_ in curves)
    n_of = {(metric, number): curve.n_seeds for (metric, _, number), curve in curves.items() if metric in titles}
    for (metric, number), n_seeds in n_of.items():
        if n_seeds < groups[number].n_seeds:
            yield (
                f"Group {groups[number].number}: the curve of {titles[metric]} is over {n_seeds} of its "
                f"{groups[number].n_seeds} seeds, because the others have not tracked it."
            )


def _on_code(groups: Sequence[Group]) -> Iterator[str]:
    for group in groups:
        if mixed := group.mixed_modules:
            yield f"Group {group.number}: its runs used different versions of {few(mixed)} (tag {OWN_CODE_TAG})."
        if len(group.commits) > 1:
            commits = ", ".join(sorted(commit[:ID_CHARS] for commit in group.commits))
            yield f"Group {group.number}: its runs used different versions of armscan: {commits}."
    of_groups = {
        group.number: " and ".join(sorted(each[:ID_CHARS] for each in group.commits))
        for group in groups
        if group.commits
    }
    if len(set(of_groups.values())) > 1:
        told = ", ".join(f"group {number} {commits}" for number, commits in of_groups.items())
        yield f"The groups used different versions of armscan: {told}. Differences may be those of the code."


def _on_volumes(groups: Sequence[Group]) -> Iterator[str]:
    if other := [group.number for group in groups if not group.has_same_volumes]:
        yield (
            f"{_numbered(other, groups)}: the runs did not have the same volumes (volumes.json): some were changed, "
            "added or removed between them, and the figures mix them."
        )


def _on_rules(groups: Sequence[Group], *, has_other_volumes: bool) -> Iterator[str]:
    if rules := differing_rules(groups):
        yield f"The groups' episodes have different rules ({', '.join(rules)}): their figures are of different tasks."
    if has_other_volumes:
        yield (
            "Not all groups were judged on the same test volumes: pairs that were not are not compared, and their "
            "figures also differ because of the volumes."
        )


def _named(group: Group, training: TrackedTraining) -> str:
    return f"{training.id} (group {group.number}, {training.label})"


def _numbered(numbers: Sequence[int], groups: Sequence[Group]) -> str:
    if len(numbers) == len(groups):
        return "All groups"
    return f"Group{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"
