"""Which volumes an agent is trained on, and which are held out to judge it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.checks import check_int, check_path, check_seed
from armscan.errors import InvalidValueError, listed
from armscan.volumes import LabelVolume, load_phantoms, read_dataset

HELD_OUT_FIRST_SEED = 1_000_000


@dataclass(frozen=True)
class Split:
    """Volumes by name.

    Args:
        training: what the agent moves through while it learns.
        held_out: what it never saw; tests at the end of an epoch and the final evaluation use them.
    """

    training: dict[str, LabelVolume]
    held_out: dict[str, LabelVolume]


def phantom_data(n_training: int = 16, n_held_out: int = 8, first_seed: int = 0, cache_dir: str | None = None) -> Split:
    """Phantom wrists; the held-out ones come from seeds that no training phantom has.

    Args:
        n_training: phantoms to train on.
        n_held_out: phantoms to judge on.
        first_seed: of the training phantoms, which have consecutive seeds.
        cache_dir: where phantoms are kept; the user's cache folder where it is None.
    """
    check_int("data.n_training", n_training, at_least=1)
    check_int("data.n_held_out", n_held_out, at_least=1)
    check_int("data.first_seed", first_seed, at_least=0)
    if first_seed + n_training > HELD_OUT_FIRST_SEED:
        raise InvalidValueError(
            f"data.first_seed + data.n_training is {first_seed + n_training}, but it must be at most "
            f"{HELD_OUT_FIRST_SEED}, where the held-out phantoms begin"
        )
    folder = None if cache_dir is None else check_path("data.cache_dir", cache_dir)
    return Split(
        training=load_phantoms(range(first_seed, first_seed + n_training), folder),
        held_out=load_phantoms(range(HELD_OUT_FIRST_SEED, HELD_OUT_FIRST_SEED + n_held_out), folder),
    )


def nifti_data(path: str, held_out: float | Sequence[str] = 0.25, split_seed: int = 0) -> Split:
    """The volumes of a folder, as `read_dataset` reads them.

    Args:
        path: the folder.
        held_out: names of the volumes to hold out, or the share of them, in (0, 1), rounded up to whole volumes.
        split_seed: draws which volumes make up the share.

    Raises:
        InvalidValueError: if nothing would be left to train on, or to judge on.
    """
    volumes = read_dataset(check_path("data.path", path))
    names = list(volumes)
    if isinstance(held_out, float | int) and not isinstance(held_out, bool):
        if not 0 < held_out < 1:
            raise InvalidValueError(f"data.held_out is {held_out!r}, but as a share it must be above 0 and below 1")
        drawn = np.random.default_rng(check_seed("data.split_seed", split_seed)).permutation(len(names))
        chosen = {names[index] for index in drawn[: math.ceil(held_out * len(names))]}
    elif isinstance(held_out, str):
        chosen = {held_out}
    elif isinstance(held_out, Sequence) and all(isinstance(name, str) for name in held_out):
        chosen = set(held_out)
    else:
        raise InvalidValueError(f"data.held_out is {held_out!r}, but it must be a share, or a list of volumes' names")
    if unknown := sorted(chosen - set(names)):
        raise InvalidValueError(f"data.held_out names {listed(unknown)}, but {path} holds {listed(names)}")
    if not chosen or len(chosen) == len(names):
        raise InvalidValueError(
            f"data.held_out = {held_out!r} leaves {len(names) - len(chosen)} of the {len(names)} volumes of {path} to "
            "train on and the others to judge on, but each needs at least one"
        )
    return Split(
        training={name: volumes[name] for name in names if name not in chosen},
        held_out={name: volumes[name] for name in names if name in chosen},
    )
