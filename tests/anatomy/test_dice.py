"""How far two slices show the same."""

import numpy as np

from armscan.anatomy import tissue_dice


def test_dice_by_hand():
    slice_xz = np.array([[1, 1, 0], [2, 2, 2], [0, 0, 4]], dtype=np.uint8)
    reference = np.array([[1, 0, 0], [3, 2, 2], [2, 2, 4]], dtype=np.uint8)
    assert tissue_dice(slice_xz, reference) == {"bones": 2 / 3, "tendons": 4 / 7, "artery": 0.0}


def test_dice_is_one_where_neither_slice_shows_the_tissue():
    nothing = np.zeros((2, 2), dtype=np.uint8)
    assert set(tissue_dice(nothing, nothing).values()) == {1.0}
