"""Splits of volumes into training, validation and test."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from armscan.errors import InvalidValueError, few
from armscan.training.fingerprints import Fingerprints
from armscan.training.subject_splits import PHANTOMS, parts_by_subject
from armscan.utils.text import counted
from armscan.utils.validation import check_choice, check_int, check_path
from armscan.volumes import Dataset, LabelVolume, load_phantoms, open_dataset
from armscan.volumes.dataset import SPLITS, check_copy, copies_among, first_volumes
from armscan.volumes.phantom import VERSIONS
from armscan.volumes.phantom.generate import PHANTOM_NAME
from armscan.volumes.volume import palm_notes

# Phantoms of different parts never have the same seed.
VALIDATION_FIRST_SEED, TEST_FIRST_SEED = 1_000_000, 2_000_000
# They take hours to make.
MAX_PHANTOMS = 100_000

PARTS = ("training", "validation", "test")
# Volumes of a part that are listed by name.
N_NAMED = 8


@dataclass(frozen=True)
class Split:
    """Volumes for training, validation and test, by name.

    Args:
        training: Volumes that the agent learns on.
        validation: Volumes of the validation after each epoch, which chooses the checkpoint and stops the training.
        test: Volumes of the final evaluation, which are not used in training.

    Raises:
        InvalidValueError: If one of the three has no volume, or two have the same volume, or copies of it.
        VolumeError: If two volumes of different subjects have the same voxels.
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
                f"{len(self.test)} for the test, each must be at least 1: give more subjects, more folds, or "
                "data.validation"
            )
        seen: dict[str, str] = {}
        for part, volumes in self.parts.items():
            for name in volumes:
                if name in seen:
                    raise InvalidValueError(f"{name} is in {seen[name]} and in {part}, but it must be in one part")
                seen[name] = part
        self._check_copies()

    def _check_copies(self) -> None:
        of_parts = {(part, name): volume for part, volumes in self.parts.items() for name, volume in volumes.items()}
        copies = [*copies_among(of_parts)]
        for (its_part, other), (part, name) in copies:
            if part != its_part:
                raise InvalidValueError(
                    f"{name} ({part}) is a copy of {other} ({its_part}), but a wrist must be in one part: "
                    "give both the same subject in the manifest, or remove one"
                )
        for (_, other), (part, name) in copies:
            check_copy(self.parts[part], other, name)

    @property
    def parts(self) -> dict[str, dict[str, LabelVolume]]:
        """The volumes by part and name."""
        return {part: getattr(self, part) for part in PARTS}

    @property
    def description(self) -> str | None:
        """The names of the volumes in each part in one line, phantoms only counted; None if all are phantoms."""
        if all(PHANTOM_NAME.fullmatch(name) for volumes in self.parts.values() for name in volumes):
            return None
        of_parts = []
        for part, volumes in self.parts.items():
            own = [name for name in volumes if not PHANTOM_NAME.fullmatch(name)]
            phantoms = [counted(len(volumes) - len(own), "phantom")] if len(own) < len(volumes) else []
            of_parts.append(f"{part}: {' and '.join([few(own, N_NAMED)] * bool(own) + phantoms)}")
        return "; ".join(of_parts)

    @property
    def palm_notes(self) -> list[str]:
        """Notes on volumes whose palm is on the other side than in the phantoms beside them."""
        volumes = {name: volume for of_part in self.parts.values() for name, volume in of_part.items()}
        own = {name: volume for name, volume in volumes.items() if not PHANTOM_NAME.fullmatch(name)}
        return palm_notes(own) if len(own) < len(volumes) else []

    def fingerprints(self) -> Fingerprints:
        """Return a checksum of each volume's contents, by part and name."""
        return {
            part: {name: volume.fingerprint for name, volume in volumes.items()} for part, volumes in self.parts.items()
        }


def phantom_data(
    n_training: int = 16,
    n_validation: int = 4,
    n_test: int = 8,
    first_seed: int = 0,
    cache_dir: str | None = None,
    version: int = 1,
) -> Split:
    """Make phantom wrists, with different seeds for training, validation and test.

    Args:
        n_training: Number of phantoms to train on, 1 or more. Default: 16.
        n_validation: Number of validation phantoms, 1 or more. Default: 4.
        n_test: Number of test phantoms, 1 or more. Default: 8.
        first_seed: Seed of the first training phantom, 0 or more; the next ones follow. Default: 0.
        cache_dir: Folder that keeps phantoms. Default: None, the user's cache folder.
        version: Version of the phantoms. 1: the labelled plane has a fixed position among bones and tendons; 2: its
            position varies. Default: 1, as in runs that name none.

    Raises:
        InvalidValueError: If a number is out of range.
    """
    counts = {"training": n_training, "validation": n_validation, "test": n_test}
    return Split(**_phantoms(counts, first_seed, cache_dir, version))


def _phantoms(
    counts: Mapping[str, int],
    first_seed: int,
    cache_dir: str | None,
    version: int,
    may_be_none: Collection[str] = (),
) -> dict[str, dict[str, LabelVolume]]:
    """Make phantoms for each part of a split; see `phantom_data`. Parts in `may_be_none` may have none."""
    for part, count in counts.items():
        check_int(f"data.n_{part}", count, at_least=0 if part in may_be_none else 1, at_most=MAX_PHANTOMS)
    check_int("data.first_seed", first_seed, at_least=0)
    if (end := first_seed + counts["training"]) > VALIDATION_FIRST_SEED:
        raise InvalidValueError(
            f"data.first_seed + data.n_training is {end}, but it must be at most {VALIDATION_FIRST_SEED}, where the "
            "validation phantoms begin"
        )
    check_choice("data.version", version, tuple(VERSIONS))
    folder = None if cache_dir is None else check_path("data.cache_dir", cache_dir)
    firsts = {"training": first_seed, "validation": VALIDATION_FIRST_SEED, "test": TEST_FIRST_SEED}
    return {part: load_phantoms(range(first, first + counts[part]), folder, version) for part, first in firsts.items()}


def nifti_data(
    path: str,
    validation: float | str | Sequence[str] | None = None,
    test: float | str | Sequence[str] | None = None,
    split_seed: int = 0,
    folds: int | str | None = None,
    fold: int | None = None,
) -> Split:
    """Return the volumes of a folder, as `open_dataset` reads them, split by subject.

    Args:
        path: Folder of the volumes.
        validation: Share of the subjects, in (0, 1], rounded up, or names of subjects or volumes. Default: None,
            the manifest's splits; a quarter if it has none or `test` is given; the next fold with `folds`.
        test: Share of the subjects, in (0, 1], rounded up, or names of subjects or volumes. Default: None,
            the manifest's splits; a quarter if it has none or `validation` is given. Must be None with `folds`.
        split_seed: Seed that draws the subjects of shares and folds. Default: 0.
        folds: Cross-validation: `leave_one_out` makes each subject a fold; or the number of folds, from 2 to that of
            the subjects. Default: None, no cross-validation.
        fold: Number of the test fold, from 0. Default: None, no cross-validation.

    Raises:
        InvalidValueError: If one of the three splits would have no volume, or a subject would be in two of them.
    """
    dataset = open_dataset(check_path("data.path", path))
    parts = parts_by_subject(dataset, {"test": test, "validation": validation}, path, split_seed, folds, fold)
    return Split(**_by_part(dataset, parts))


def _by_part(dataset: Dataset, parts: Mapping[str, str]) -> dict[str, dict[str, LabelVolume]]:
    """Return the volumes of each part of a split, which manifests call `train`, `validation` and `test`."""
    return {
        part: {name: volume for name, volume in dataset.volumes.items() if parts[name] == in_manifest}
        for part, in_manifest in zip(PARTS, SPLITS, strict=True)
    }


def mixed_data(
    path: str,
    n_volumes: int | None = None,
    n_training: int = 16,
    n_validation: int = 4,
    n_test: int = 8,
    first_seed: int = 0,
    cache_dir: str | None = None,
    version: int = 1,
    validation: float | str | Sequence[str] | None = PHANTOMS,
    test: float | str | Sequence[str] | None = PHANTOMS,
    split_seed: int = 0,
    folds: int | str | None = None,
    fold: int | None = None,
) -> Split:
    """Split the volumes of a folder by subject, and add phantom wrists to the training volumes.

    Args:
        path: Folder of the volumes.
        n_volumes: Number of its volumes to use, the first by name, 1 or more. Default: None, all.
        n_training: Number of training phantoms besides the volumes, 0 or more. Default: 16.
        n_validation: Number of validation phantoms, with `validation=phantoms`, 1 or more. Default: 4.
        n_test: Number of test phantoms, with `test=phantoms`, 1 or more. Default: 8.
        first_seed: Seed of the first training phantom, 0 or more; the next ones follow. Default: 0.
        cache_dir: Folder that keeps phantoms. Default: None, the user's cache folder.
        version: Version of the phantoms, 1 or 2; see `phantom_data`. Default: 1.
        validation: Validation volumes; see `nifti_data`. `phantoms` uses no subjects. Default: `phantoms`, as in runs
            that name none.
        test: Test volumes; see `nifti_data`. `phantoms` uses no subjects. Default: `phantoms`, as in runs that name
            none.
        split_seed: Seed that draws the subjects of shares and folds. Default: 0.
        folds: Cross-validation; see `nifti_data`. Default: None.
        fold: Number of the test fold, from 0. Default: None.

    Raises:
        InvalidValueError: If a number is out of range, or the volumes cannot be split this way.
    """
    given = {"test": test, "validation": validation}
    wanted = {part: each for part, each in given.items() if each != PHANTOMS}
    counts = {"training": n_training, "validation": n_validation, "test": n_test} | dict.fromkeys(wanted, 0)
    phantoms = _phantoms(counts, first_seed, cache_dir, version, may_be_none={"training", *wanted})
    dataset = open_dataset(check_path("data.path", path))
    dataset = replace(dataset, volumes=first_volumes(dataset.volumes, n_volumes))
    parts = parts_by_subject(dataset, wanted, path, split_seed, folds, fold)
    return Split(**{part: volumes | phantoms[part] for part, volumes in _by_part(dataset, parts).items()})
