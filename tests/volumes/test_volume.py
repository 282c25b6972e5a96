"""Arguments of labelmap volumes."""

import numpy as np
import pytest

from armscan.errors import VolumeError
from armscan.volumes import LabelVolume

SPACING = (0.5, 0.5, 0.5)


def labels_with(*values, dtype=np.uint8):
    labels = np.zeros((4, 4, 4), dtype=dtype)
    labels.flat[: len(values)] = values
    return labels


def test_volume_keeps_whole_valued_floats_as_bytes():
    volume = LabelVolume(labels_with(1, 2, 3, 4, dtype=np.float64), SPACING, "v")
    assert volume.labels.dtype == np.uint8
    assert volume.labels_yxz.flags.c_contiguous
    np.testing.assert_array_equal(volume.labels.flat[:5], [1, 2, 3, 4, 0])


def test_volume_does_not_change_with_the_array_it_was_made_of():
    labels = labels_with(1, 2, 3)
    volume = LabelVolume(labels, SPACING, "v")
    labels[:] = 0
    assert volume.labels.any()


def test_volume_measures_itself():
    volume = LabelVolume(labels_with(1, 2, 3), (0.5, 1.0, 2.0), "v")
    assert volume.size_mm == (2.0, 4.0, 8.0)
    assert volume.centre_mm == (0.75, 1.5, 3.0)
    assert volume.slice_shape == (4, 4)
    assert volume.pixel_mm == (0.5, 2.0)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (np.zeros((4, 4), np.uint8), r"wrist: .*shape \(4, 4\).*3-D"),
        (np.zeros((4, 4, 4, 2), np.uint8), r"wrist: .*shape \(4, 4, 4, 2\).*3-D"),
        (np.zeros((4, 0, 4), np.uint8), "wrist: .*not empty"),
        (labels_with(1, 2, 3, 1.5, dtype=float), "wrist: .*not whole numbers"),
        (labels_with(1, 2, 3, np.nan, dtype=float), "wrist: .*not whole numbers"),
        (labels_with(1, 2, 3, 7), "wrist: .*values 0, 1, 2, 3, 7"),
        (labels_with(1, 2, 3, -1, dtype=np.int16), "wrist: .*values -1, 0, 1, 2, 3"),
        (labels_with(1, 2, 3, 300, dtype=np.int32), "wrist: .*300"),
        (labels_with(1, 2), "wrist: no voxel is labelled 3 .artery"),
        (labels_with(2, 3), "wrist: no voxel is labelled 1 .bones"),
        (labels_with(2), "wrist: no voxel is labelled 1 .bones. or 3 .artery., but every"),
        (labels_with("a", "b", dtype="U1"), "wrist: "),
    ],
)
def test_volume_refuses_what_is_no_labelmap(labels, message):
    with pytest.raises(VolumeError, match=message):
        LabelVolume(labels, SPACING, "wrist")


def test_volume_refuses_an_optimal_plane_that_is_none():
    with pytest.raises(VolumeError, match=r"wrist: optimal_action is \(0, 1\)"):
        LabelVolume(labels_with(1, 2, 3), SPACING, "wrist", optimal_action=(0, 1))


@pytest.mark.parametrize(
    "spacing",
    [(1e-308, 1.0, 1.0), (1.0, 1e308, 1.0), (0, 1, 1), (-1, 1, 1), (np.nan, 1, 1), (np.inf, 1, 1), (1, 1), "abc", None],
)
def test_volume_refuses_impossible_spacing(spacing):
    with pytest.raises(VolumeError, match="wrist: spacing is"):
        LabelVolume(labels_with(1, 2, 3), spacing, "wrist")
