"""How far two slices show the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armscan.volumes import LABEL_NAMES, LANDMARK_LABELS


def tissue_dice(slice_xz: NDArray[np.uint8], reference_xz: NDArray[np.uint8]) -> dict[str, float]:
    """Return the Dice coefficient of each landmark tissue in two slices of one shape, by its name.

    It is twice the pixels that both have of the tissue, over the pixels that either has: 1 where they are the same, 0
    where none is shared. Where neither slice shows the tissue, they agree: 1.

    Args:
        slice_xz: labels, indexed [across, depth].
        reference_xz: likewise.
    """
    return {LABEL_NAMES[label]: _dice(slice_xz == label, reference_xz == label) for label in LANDMARK_LABELS}


def _dice(mask: NDArray[np.bool_], reference: NDArray[np.bool_]) -> float:
    total = int(np.count_nonzero(mask)) + int(np.count_nonzero(reference))
    return 2.0 * int(np.count_nonzero(mask & reference)) / total if total else 1.0
