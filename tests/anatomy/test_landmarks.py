"""What is seen in a slice."""

import numpy as np
import pytest

from armscan.anatomy import TissueClusters
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
