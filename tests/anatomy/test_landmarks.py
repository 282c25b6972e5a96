"""Summaries of slices."""

import numpy as np
import pytest

from armscan.anatomy import TissueClusters, nerve_area_error, tissue_dice
from armscan.errors import InvalidValueError


@pytest.mark.parametrize("slice_xz", [np.zeros((3, 3, 3), int), np.zeros((3, 3)), np.zeros(3, int)])
def test_tissue_clusters_refuse_what_is_no_slice_of_labels(slice_xz):
    with pytest.raises(InvalidValueError, match="the slice is an array of shape"):
        TissueClusters.from_slice(slice_xz)


def test_tissue_clusters_of_an_empty_slice_are_none():
    clusters = TissueClusters.from_slice(np.zeros((5, 6), np.uint8))
    assert clusters.counts == (0, 0, 0)
    np.testing.assert_array_equal(clusters.bones.mean_centre, [0, 0])
    np.testing.assert_array_equal(clusters.landmarks, np.zeros((3, 4)))


def test_dice_by_hand():
    slice_xz = np.array([[1, 1, 0], [2, 2, 2], [0, 0, 4]], dtype=np.uint8)
    reference = np.array([[1, 0, 0], [3, 2, 2], [2, 2, 4]], dtype=np.uint8)
    assert tissue_dice(slice_xz, reference) == {"bones": 2 / 3, "tendons": 4 / 7, "artery": 0.0}


def test_dice_is_one_where_neither_slice_shows_the_tissue():
    nothing = np.zeros((2, 2), dtype=np.uint8)
    assert set(tissue_dice(nothing, nothing).values()) == {1.0}


def test_nerve_area_error_by_hand():
    reference = np.array([[4, 4, 4], [4, 2, 0]], dtype=np.uint8)
    pixel_mm = (0.5, 0.25)
    for shown, off_mm2, off_percent in (
        (reference, 0.0, 0.0),
        (reference[:1], 0.125, 25.0),
        (0 * reference, 0.5, 100.0),
    ):
        assert nerve_area_error(shown, reference, pixel_mm) == (off_mm2, off_percent)
    assert nerve_area_error(np.full((3, 3), 4), reference, pixel_mm) == (0.625, 125.0)


def test_nerve_area_error_is_nothing_where_the_reference_shows_no_nerve():
    assert nerve_area_error(np.full((2, 2), 4), np.ones((2, 2), np.uint8), (1.0, 1.0)) == (None, None)
