"""Mapping from the values of a file to tissues."""

import numpy as np
import pytest

from armscan.errors import InvalidValueError, VolumeError
from armscan.volumes import LabelMap, LabelVolume, open_dataset, read_volume
from armscan.volumes.labelmap import FoundSource, map_values

MAP = LabelMap(bones=[10, 11], tendons=[20], artery=[30])
TINY_VALUES = {1: 10, 2: 20, 3: 30}


def numbered(labels, values, dtype=np.int32):
    """Return the labels 1, 2, 3 stored as other values."""
    stored = np.zeros(labels.shape, dtype)
    for label, value in values.items():
        stored[labels == label] = value
    return stored


@pytest.mark.parametrize("dtype", [np.int16, np.uint32, np.int64, np.uint64, np.float32, np.float64])
def test_read_volume_maps_values_of_any_type(write_labelmap, tiny_volume, dtype):
    stored = numbered(tiny_volume.labels, TINY_VALUES, dtype)
    stored[5:8, 4:15, 2:5] = 11
    volume = read_volume(write_labelmap("wrist.nrrd", labels=stored), labels=MAP)
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels)


@pytest.mark.parametrize(
    ("values", "dtype"),
    [
        ((300, 1000, 65535), np.uint16),
        ((-1, -200, 7), np.int16),
        ((-(2**31), 5, 2**31 - 1), np.int32),
        ((2**62, 2**63 + 5, 2**64 - 1), np.uint64),
        ((2**63 + 5, 2**63 + 6, 2**63 + 7), np.uint64),
        ((-(2**63), -(2**63) + 1, 2**62), np.int64),
        ((-1e15, 1.0, 1e15), np.float64),
        ((255, 254, 253), np.uint8),
        ((-128, 127, 1), np.int8),
    ],
)
def test_map_values_takes_any_whole_number(tiny_volume, values, dtype):
    stored = numbered(tiny_volume.labels, dict(zip((1, 2, 3), values, strict=True)), dtype)
    labels, found = map_values(stored, LabelMap(*[[int(value)] for value in values]), "wrist")
    np.testing.assert_array_equal(labels, tiny_volume.labels)
    n_voxels = {each.source: each.n_voxels for each in found}
    assert n_voxels == {
        0: (tiny_volume.labels == 0).sum(),
        **{int(value): (tiny_volume.labels == label).sum() for label, value in zip((1, 2, 3), values, strict=True)},
    }


def test_map_values_tells_what_it_found():
    _, found = map_values(np.array([[[0, 7, 30]]]), LabelMap([7], [8], [9], background=[30]), "wrist")
    assert found == (FoundSource(0, 0, 1), FoundSource(7, 1, 1), FoundSource(30, 0, 1))


def test_label_map_takes_0_for_background_unless_a_tissue_names_it():
    assert MAP.label_of(0) == 0
    assert LabelMap([0], [1], [2], background=[3]).label_of(0) == 1


def test_read_volume_refuses_values_that_are_not_mapped(write_labelmap, tiny_volume):
    stored = numbered(tiny_volume.labels, TINY_VALUES | {3: 31})
    with pytest.raises(VolumeError, match=r"wrist\.nii\.gz: holds 31, which the label map does not name"):
        read_volume(write_labelmap(labels=stored), labels=MAP)


def test_read_volume_makes_others_background_where_that_is_said(write_labelmap, tiny_volume):
    stored = numbered(tiny_volume.labels, TINY_VALUES)
    stored[0, 0] = 999
    volume = read_volume(
        write_labelmap(labels=stored), labels=LabelMap(bones=[10], tendons=[20], artery=[30], others="background")
    )
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels)


def test_read_volume_refuses_a_landmark_that_the_map_finds_nowhere(write_labelmap, tiny_volume):
    labels = LabelMap(bones=[10], tendons=[20], artery=[30, 33], nerve=[300])
    stored = numbered(tiny_volume.labels, {1: 10, 2: 20, 3: 300})
    with pytest.raises(VolumeError, match=r"no voxel is artery .30, 33. by .*; the file holds 0, 10, 20, 300"):
        read_volume(write_labelmap(labels=stored), labels=labels)


@pytest.mark.parametrize("value", [7, 255, 256, 300, 40000, -1])
def test_read_volume_without_a_map_names_the_values_that_are_no_labels(write_labelmap, tiny_volume, value):
    stored = tiny_volume.labels.astype(np.int32)
    stored[0, 0, 0] = value
    with pytest.raises(VolumeError, match=rf"wrist\.nii\.gz: holds the values .*{value}.* only; if it is no image"):
        read_volume(write_labelmap(labels=stored))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", ["wrist.nii", "wrist.nii.gz", "wrist.nrrd", "wrist.mha"])
@pytest.mark.parametrize("damage", [0.5, np.nan, np.inf, -np.inf, 1e30])
def test_read_volume_refuses_values_that_are_not_whole(write_labelmap, tiny_volume, name, dtype, damage):
    stored = tiny_volume.labels.astype(dtype)
    stored[-1, -1, -1] = damage
    with pytest.raises(VolumeError, match=rf"{name}: holds (float\d\d values between|a voxel that is NaN or infinite)"):
        read_volume(write_labelmap(name, labels=stored), labels=LabelMap([1], [2], [3], others="background"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bones": []}, "bones is empty"),
        ({"bones": ()}, "bones is empty"),
        ({"bones": "Scaphoid"}, "bones is 'Scaphoid', but it must be a list"),
        ({"bones": 3}, "bones is 3, but"),
        ({"bones": [True]}, r"bones is \[True\], but"),
        ({"bones": [1.0]}, r"bones is \[1\.0\], but"),
        ({"bones": [None]}, r"bones is \[None\], but"),
        ({"nerve": [20]}, "20 is tendons and nerve"),
        ({"bones": [1, 1]}, "1 is bones and bones"),
        ({"others": "bones"}, "others is 'bones', but"),
        ({"others": True}, "others is True, but"),
    ],
)
def test_label_map_refuses_what_is_none(changes, message):
    with pytest.raises(InvalidValueError, match=f"labels: {message}"):
        LabelMap(**({"bones": [10], "tendons": [20], "artery": [30]} | changes))


@pytest.mark.parametrize("mapping", [None, [1], "bones", 3])
def test_label_map_refuses_what_is_no_mapping(mapping):
    with pytest.raises(InvalidValueError, match="labels is"):
        LabelMap.from_mapping(mapping)


def test_read_volume_refuses_what_is_no_label_map(write_labelmap):
    with pytest.raises(VolumeError, match=r"wrist\.nii\.gz: labels is {'bones': \[1\]}, but it must be a LabelMap"):
        read_volume(write_labelmap(), labels={"bones": [1]})


def test_report_tells_what_the_file_held_and_what_became_of_it(write_labelmap, tmp_path, tiny_volume):
    stored = numbered(tiny_volume.labels, TINY_VALUES)
    stored[0, 0, :5] = 999
    write_labelmap("a.nrrd", labels=stored, spacing=(0.5, 0.5, 2.0, 1.0))
    (tmp_path / "manifest.yaml").write_text(
        'labels: {bones: [10, 11], tendons: [20], artery: [30, "31", Ulnar artery], others: background}'
    )
    report = open_dataset(tmp_path).reports["a.nrrd"]
    assert {each.source: (each.label, each.n_voxels) for each in report.stored.found}[999] == (0, 5)
    assert report.stored.missing == (11, "31")
    assert report.n_voxels["bones"] == (tiny_volume.labels == 1).sum()
    assert report.tissue_mm3["bones"] == pytest.approx(0.5 * (tiny_volume.labels == 1).sum())
    assert report.n_voxels["nerve"] == 0
    assert (report.volume.shape, report.orientation, report.stored.orientation) == (tiny_volume.shape, "LPS", "LPS")


@pytest.mark.parametrize("name", ["thin.nrrd", "thin.nii.gz", "thin.mha"])
def test_volume_of_one_voxels_thickness_is_a_volume(write_labelmap, name):
    """Along any axis; a plane beside it shows background."""
    from armscan.volumes import ManipulatorAction

    for axis in range(3):
        shape = [4, 4, 4]
        shape[axis] = 1
        labels = np.zeros(shape, np.uint8)
        labels.flat[:3] = (1, 2, 3)
        volume = read_volume(write_labelmap(name, labels=labels))
        np.testing.assert_array_equal(volume.labels, labels)
        assert isinstance(volume, LabelVolume)
        assert not volume.slice(ManipulatorAction((0.0, 0.0), (0.0, 50.0))).any()
        assert volume.slice(ManipulatorAction((0.0, 0.0), (0.0, 0.0))).any()
