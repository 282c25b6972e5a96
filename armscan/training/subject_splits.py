"""Splits of a folder's subjects into training, validation and test: by name, by share, or by fold."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import islice

import numpy as np

from armscan.errors import InvalidValueError, listed
from armscan.utils.text import looks_like_one_of
from armscan.utils.validation import check_float, check_int, check_seed
from armscan.volumes import Dataset

DEFAULT_SHARE = 0.25
# 0.28 of 25 is a little above 7 in floats, and not to be rounded up to 8.
ROUNDING = 1e-9
# Choice of phantoms instead of subjects.
PHANTOMS = "phantoms"
LEAVE_ONE_OUT = "leave_one_out"
# For each part, a share of the subjects, names, or None for the default.
Wanted = dict[str, float | str | Sequence[str] | None]


def n_folds(folds: object, n_subjects: int) -> int:
    """Return the number of folds.

    Args:
        folds: `leave_one_out`, which makes each subject a fold; or the number of folds, from 2 to the number of
            subjects.
        n_subjects: Number of subjects.

    Raises:
        InvalidValueError: If it is neither, or there are fewer than two subjects.
    """
    if n_subjects < 2:
        raise InvalidValueError(f"data.folds is {folds!r}, but there must be two subjects or more, not {n_subjects}")
    if folds == LEAVE_ONE_OUT:
        return n_subjects
    if isinstance(folds, str):
        raise InvalidValueError(f"data.folds is {folds!r}, but it must be {LEAVE_ONE_OUT!r} or a number from 2 on")
    return check_int("data.folds", folds, at_least=2, at_most=n_subjects)


def test_and_next_fold(subjects: Sequence[str], folds: object, fold: object, seed: int) -> tuple[list[str], list[str]]:
    """Return the subjects of the test fold, and those of the fold after it.

    Args:
        subjects: All subjects, each once.
        folds: Folds; see `n_folds`.
        fold: Number of the fold, from 0.
        seed: Seed that draws the subjects of each fold; unused with `leave_one_out`.

    Raises:
        InvalidValueError: If there is no such fold.
    """
    count = n_folds(folds, len(subjects))
    if fold is None:
        raise InvalidValueError(
            f"data.folds is {folds!r}, but data.fold is None: give one fold, data.fold=0 to {count - 1}. armscan run "
            "runs every fold if its command line or experiment sets data.folds; a study does not"
        )
    number = check_int("data.fold", fold, at_least=0, at_most=count - 1)
    order = np.random.default_rng(check_seed("data.split_seed", seed)).permutation(len(subjects))
    chosen = np.arange(len(subjects)) if folds == LEAVE_ONE_OUT else order
    groups = [[subjects[index] for index in sorted(group)] for group in np.array_split(chosen, count)]
    return groups[number], groups[(number + 1) % count]


def check_folds(folds: object, test: object) -> None:
    """Raise `InvalidValueError` if test volumes are given besides folds."""
    if test is not None:
        raise InvalidValueError(
            f"data.folds is {folds!r}, which says what is tested on, but data.test is {test!r}: it must be null"
        )


def parts_by_subject(
    dataset: Dataset, wanted: Wanted, path: str, split_seed: int, folds: int | str | None, fold: int | None
) -> dict[str, str]:
    """Return the split of each volume, by name: `train`, `validation` or `test`.

    Args:
        dataset: Volumes and their subjects.
        wanted: Choice of `validation` and `test`, by their names; a missing part gets no volume.
        path: Folder of the volumes, for errors.
        split_seed: Seed that draws the subjects of shares and folds.
        folds: Folds; see `n_folds`. None: no cross-validation.
        fold: Number of the test fold; None without folds.

    Raises:
        InvalidValueError: If the volumes cannot be split this way.
    """
    if folds is None and fold is not None:
        raise InvalidValueError(
            f"data.fold is {fold!r}, but data.folds is null: give data.folds=leave_one_out, or their number"
        )
    if folds is not None:
        check_folds(folds, wanted.get("test", PHANTOMS))
        test, after = test_and_next_fold(list(dict.fromkeys(dataset.subjects.values())), folds, fold, split_seed)
        of_next = {"validation": after} if "validation" in wanted and wanted["validation"] is None else {}
        wanted = {**wanted, "test": test, **of_next}
    elif dataset.splits is not None and all(each is None for each in wanted.values()):
        return {name: dataset.splits[name] if dataset.splits[name] in wanted else "train" for name in dataset.volumes}
    return _drawn(dataset, wanted, path, split_seed)


def _drawn(dataset: Dataset, wanted: Wanted, path: str, split_seed: int) -> dict[str, str]:
    """Return the split of each volume: named subjects first, then shares of the others."""
    subjects = dataset.subjects
    parts: dict[str, str] = {}
    shares: dict[str, float] = {}
    for part, given in wanted.items():
        if isinstance(given, str | list | tuple):
            for volume in _named(dataset, [given] if isinstance(given, str) else given, part, path):
                if parts.setdefault(volume, part) != part:
                    raise InvalidValueError(f"data.{part} and data.{parts[volume]} both name {volume}")
        else:
            shares[part] = DEFAULT_SHARE if given is None else _share(f"data.{part}", given)
    taken = {subjects[volume] for volume in parts}
    left = [subject for subject in dict.fromkeys(subjects.values()) if subject not in taken]
    drawn = iter(np.random.default_rng(check_seed("data.split_seed", split_seed)).permutation(len(left)))
    n_subjects = len(set(subjects.values()))
    for part, share in shares.items():
        chosen = {left[index] for index in islice(drawn, math.ceil(share * n_subjects - ROUNDING))}
        parts |= {volume: part for volume, subject in subjects.items() if subject in chosen}
    parts = {volume: parts.get(volume, "train") for volume in subjects}
    _check_subjects(parts, subjects)
    return parts


def _named(dataset: Dataset, names: Sequence[str], part: str, path: str) -> list[str]:
    """Return the volumes that are named, directly or by their subject."""
    known = [*dataset.volumes, *dataset.subjects.values()]
    if not all(isinstance(name, str) for name in names):
        raise InvalidValueError(f"data.{part} is {names!r}, but it must be a share, or names of subjects or volumes")
    if unknown := [name for name in names if name not in known]:
        hint = ", which look alike" if any(looks_like_one_of(name, known) for name in unknown) else ""
        raise InvalidValueError(
            f"data.{part} names {listed(unknown)}, but {path} holds {listed(dict.fromkeys(known))}{hint}"
        )
    return [volume for volume, subject in dataset.subjects.items() if volume in names or subject in names]


def _share(name: str, given: object) -> float:
    try:
        return check_float(name, given, above=0.0, at_most=1.0)
    except InvalidValueError as error:
        raise InvalidValueError(
            f"{name} is {given!r}, but it must be a share above 0 and at most 1, or names of subjects or volumes"
        ) from error


def _check_subjects(parts: dict[str, str], subjects: dict[str, str]) -> None:
    first: dict[str, str] = {}
    for volume, subject in subjects.items():
        part = parts[first.setdefault(subject, volume)]
        if part != parts[volume]:
            raise InvalidValueError(
                f"{first[subject]} is for {part} and {volume} for {parts[volume]}, but both are of the subject "
                f"{subject}, which must be in one part: name all of its volumes, or the subject"
            )
