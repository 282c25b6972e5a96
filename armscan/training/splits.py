"""Which volumes an agent is trained on, which choose its checkpoint, and which judge it at the end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from armscan.errors import InvalidValueError, listed
from armscan.training.fingerprints import Fingerprints, fingerprint
from armscan.utils.validation import LARGEST_SEED, check_choice, check_float, check_int, check_path, check_seed
from armscan.volumes import Dataset, LabelVolume, load_phantoms, open_dataset
from armscan.volumes.dataset import SPLITS
from armscan.volumes.phantom import VERSIONS

# No phantom of one purpose has the seed of another.
VALIDATION_FIRST_SEED, TEST_FIRST_SEED = 1_000_000, 2_000_000
DEFAULT_SHARE = 0.25

PARTS = ("training", "validation", "test")


@dataclass(frozen=True)
class Split:
    """Volumes by name.

    Args:
        training: volumes that the agent learns on.
        validation: what it is tested on after each epoch; these choose the checkpoint and stop the training.
        test: what has no part in training at all; the final evaluation judges by them.

    Raises:
        InvalidValueError: if one of the three has no volume, or two have the same.
    """

    training: dict[str, LabelVolume]
    validation: dict[str, LabelVolume]
    test: dict[str, LabelVolume]

    def __post_init__(self) -> None:
        for part, volumes in self.parts.items():
            if not isinstance(volumes, dict) or not all(isinstance(each, LabelVolume) for each in volumes.values()):
                raise InvalidValueError(f"the {part} volumes are {volumes!r}, but they must be volumes by name")
        if not all(self.parts.values()):
            raise InvalidValueError(
                f"of {len(self.training)} volumes for training, {len(self.validation)} for validation and "
                f"{len(self.test)} for the test, each must be at least 1: the volumes must be of three subjects or more"
            )
        seen: dict[str, str] = {}
        for part, volumes in self.parts.items():
            for name in volumes:
                if name in seen:
                    raise InvalidValueError(f"{name} is in {seen[name]} and in {part}, but it must be in one split")
                seen[name] = part

    @property
    def parts(self) -> dict[str, dict[str, LabelVolume]]:
        """The volumes by split and name."""
        return {part: getattr(self, part) for part in PARTS}

    def fingerprints(self) -> Fingerprints:
        """Return a sum of each volume's contents, by split and name."""
        return {
            part: {name: fingerprint(volume) for name, volume in volumes.items()}
            for part, volumes in self.parts.items()
        }


def phantom_data(
    n_training: int = 16,
    n_validation: int = 4,
    n_test: int = 8,
    first_seed: int = 0,
    cache_dir: str | None = None,
    version: int = 1,
) -> Split:
    """Phantom wrists; those for validation and test come from seeds that no training phantom has.

    Args:
        n_training: number of phantoms to train on.
        n_validation: number of phantoms that choose the checkpoint.
        n_test: number of phantoms to judge on.
        first_seed: seed of the first of the training phantoms, which have consecutive seeds.
        cache_dir: folder where phantoms are kept; the user's cache folder where it is None.
        version: version of the phantoms, 1 or 2, as in `make_phantom`. Default: 1, as runs have had it that name none.

    Raises:
        InvalidValueError: if a number is out of range.
    """
    check_int("data.n_training", n_training, at_least=1)
    check_int("data.n_validation", n_validation, at_least=1, at_most=TEST_FIRST_SEED - VALIDATION_FIRST_SEED)
    check_int("data.n_test", n_test, at_least=1, at_most=LARGEST_SEED + 1 - TEST_FIRST_SEED)
    check_int("data.first_seed", first_seed, at_least=0)
    if first_seed + n_training > VALIDATION_FIRST_SEED:
        raise InvalidValueError(
            f"data.first_seed + data.n_training is {first_seed + n_training}, but it must be at most "
            f"{VALIDATION_FIRST_SEED}, where the validation phantoms begin"
        )
    check_choice("data.version", version, tuple(VERSIONS))
    folder = None if cache_dir is None else check_path("data.cache_dir", cache_dir)
    return Split(
        training=load_phantoms(range(first_seed, first_seed + n_training), folder, version),
        validation=load_phantoms(range(VALIDATION_FIRST_SEED, VALIDATION_FIRST_SEED + n_validation), folder, version),
        test=load_phantoms(range(TEST_FIRST_SEED, TEST_FIRST_SEED + n_test), folder, version),
    )


def nifti_data(
    path: str,
    validation: float | str | Sequence[str] | None = None,
    test: float | str | Sequence[str] | None = None,
    split_seed: int = 0,
) -> Split:
    """Return the volumes of a folder, as `open_dataset` reads them, split by subject.

    Args:
        path: the folder.
        validation: a share of the subjects, in (0, 1), rounded up; or the names of subjects or volumes. None: as the
            manifest's splits say; where it has none, or `test` is given, a quarter.
        test: likewise, with `validation` the other way round.
        split_seed: draws which subjects make up the shares.

    Raises:
        InvalidValueError: if one of the three splits would have no volume, or a subject would be in two of them.
    """
    dataset = open_dataset(check_path("data.path", path))
    if validation is None and test is None and dataset.splits is not None:
        parts = dataset.splits
    else:
        parts = _drawn(dataset, {"test": test, "validation": validation}, path, split_seed)
    return Split(*({n: v for n, v in dataset.volumes.items() if parts[n] == part} for part in SPLITS))


def mixed_data(
    path: str,
    n_volumes: int | None = None,
    n_training: int = 16,
    n_validation: int = 4,
    n_test: int = 8,
    first_seed: int = 0,
    cache_dir: str | None = None,
    version: int = 1,
) -> Split:
    """Volumes of a folder to train on, and phantom wrists beside them; validation and test are on phantoms alone.

    Args:
        path: the folder.
        n_volumes: number of its volumes to use, the first by name; None for all.
        n_training: number of phantoms to train on beside them, which may be 0.
        n_validation: number of phantoms that choose the checkpoint.
        n_test: number of phantoms to judge on.
        first_seed: seed of the first of the training phantoms.
        cache_dir: folder where phantoms are kept; the user's cache folder where it is None.
        version: version of the phantoms, as in `phantom_data`. Default: 1.

    Raises:
        InvalidValueError: if a number is out of range.
    """
    n_beside = check_int("data.n_training", n_training, at_least=0)
    phantoms = phantom_data(max(n_beside, 1), n_validation, n_test, first_seed, cache_dir, version)
    volumes = open_dataset(check_path("data.path", path)).volumes
    if n_volumes is not None:
        check_int("data.n_volumes", n_volumes, at_least=1, at_most=len(volumes))
    chosen = {name: volumes[name] for name in sorted(volumes)[:n_volumes]}
    return Split({**chosen, **(phantoms.training if n_beside else {})}, phantoms.validation, phantoms.test)


def _drawn(
    dataset: Dataset, wanted: dict[str, float | str | Sequence[str] | None], path: str, split_seed: int
) -> dict[str, str]:
    """Return the split of each volume: first what is named, then shares of the subjects that are left."""
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
        chosen = {left[index] for index in islice(drawn, math.ceil(share * n_subjects))}
        parts |= {volume: part for volume, subject in subjects.items() if subject in chosen}
    parts = {volume: parts.get(volume, "train") for volume in subjects}
    _check_subjects(parts, subjects)
    return parts


def _named(dataset: Dataset, names: Sequence[str], part: str, path: str) -> list[str]:
    """Return the volumes that are named, themselves or by their subject."""
    known = [*dataset.volumes, *dataset.subjects.values()]
    if not all(isinstance(name, str) for name in names):
        raise InvalidValueError(f"data.{part} is {names!r}, but it must be a share, or names of subjects or volumes")
    if unknown := [name for name in names if name not in known]:
        raise InvalidValueError(f"data.{part} names {listed(unknown)}, but {path} holds {listed(dict.fromkeys(known))}")
    return [volume for volume, subject in dataset.subjects.items() if volume in names or subject in names]


def _share(name: str, given: object) -> float:
    try:
        return check_float(name, given, above=0.0, at_most=1.0)
    except InvalidValueError as error:
        raise InvalidValueError(
            f"{name} is {given!r}, but it must be a share above 0 and below 1, or names of subjects or volumes"
        ) from error


def _check_subjects(parts: dict[str, str], subjects: dict[str, str]) -> None:
    first: dict[str, str] = {}
    for volume, subject in subjects.items():
        part = parts[first.setdefault(subject, volume)]
        if part != parts[volume]:
            raise InvalidValueError(
                f"{first[subject]} is for {part} and {volume} for {parts[volume]}, but both are of the subject "
                f"{subject}, which must be in one split: name all of its volumes, or the subject"
            )
