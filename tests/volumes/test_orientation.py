"""Orientation, order of axes and crop: the array turns, and every voxel stays where it is in the world."""

import itertools

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from armscan.errors import VolumeError
from armscan.volumes import open_dataset, read_volume
from armscan.volumes.orientation import check_orientation, orientation_of
from armscan.volumes.plane import rotation_matrix

ORIENTATIONS = [
    "".join(letters) for pairs in itertools.permutations(("RL", "AP", "SI")) for letters in itertools.product(*pairs)
]
ORDERS = ["".join(order) for order in itertools.permutations("xyz")]
SHAPE, SPACING = (5, 6, 7), np.array([0.5, 0.75, 1.25])


def block():
    """Return a block of numbered voxels; `labels_of` turns the numbers into labels."""
    return np.arange(np.prod(SHAPE), dtype=np.int64).reshape(SHAPE)


def labels_of(numbers):
    return (numbers % 3 + 1).astype(np.uint8)


def world(volume):
    """Return the positions of the volume's voxels, shape (n, 3), with their labels."""
    indices = np.argwhere(np.ones(volume.shape, bool))
    positions = np.array(volume.origin) + indices * np.array(volume.spacing) @ volume.direction.T
    return positions, volume.labels[tuple(indices.T)]


def written(folder, direction, origin, name="turned.nrrd"):
    import SimpleITK

    image = SimpleITK.GetImageFromArray(np.ascontiguousarray(labels_of(block()).T))
    image.SetSpacing(SPACING.tolist())
    image.SetOrigin(origin)
    image.SetDirection(direction.ravel().tolist())
    SimpleITK.WriteImage(image, str(folder / name))
    return folder / name


def assert_subset(part, whole):
    """Assert that the whole has every voxel of the part, at the same position and with the same label."""
    distances = np.linalg.norm(part[0][:, None] - whole[0][None], axis=2)
    nearest = distances.argmin(axis=1)
    assert distances[np.arange(len(nearest)), nearest].max() < 1e-4
    np.testing.assert_array_equal(part[1], whole[1][nearest])


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    signs=st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3),
    stored_order=st.permutations(range(3)),
    tilt=st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
    origin=st.tuples(*[st.floats(-200, 200)] * 3),
    orientation=st.sampled_from([None, *ORIENTATIONS]),
    axes=st.sampled_from(ORDERS),
    crop_mm=st.none() | st.dictionaries(st.sampled_from("xyz"), st.just((0.5, 4.0)), min_size=1),
)
def test_read_volume_leaves_every_voxel_where_it_is_in_the_world(
    tmp_path, signs, stored_order, tilt, origin, orientation, axes, crop_mm
):
    direction = rotation_matrix(tilt[0], tilt[1]) @ np.diag(signs)[:, stored_order]
    path = written(tmp_path, direction, origin)
    whole, turned = read_volume(path), read_volume(path, orientation=orientation, axes=axes, crop_mm=crop_mm)
    assert_subset(world(turned), world(whole))
    if crop_mm is None:
        assert turned.labels.size == whole.labels.size


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_read_volume_turns_the_axes_as_asked(tmp_path, orientation):
    volume = read_volume(written(tmp_path, np.eye(3), (1.0, 2.0, 3.0)), orientation=orientation)
    assert orientation_of(volume.direction) == orientation


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1))
def test_orientation_of_oblique_axes_names_each_world_axis_once(seed):
    orientation = orientation_of(Rotation.random(rng=np.random.default_rng(seed)).as_matrix())
    assert check_orientation(orientation) == orientation


def test_nifti_without_directions_is_read_as_lps_and_not_oriented(tmp_path):
    path = written(tmp_path, np.eye(3), [0.0, 0.0, 0.0], "a.nii")
    contents = bytearray(path.read_bytes())
    # The codes of qform and sform.
    contents[252:256] = bytes(4)
    path.write_bytes(contents)
    np.testing.assert_array_equal(read_volume(path).labels, labels_of(block()))
    notes = open_dataset(tmp_path, require_manifest=False).reports["a.nii"].notes
    assert "the file states no directions of its axes (no qform and no sform); LPS is assumed" in notes
    with pytest.raises(VolumeError, match="orientation is 'RAS', but the file states no directions"):
        read_volume(path, orientation="RAS")


def test_read_volume_names_the_axes_after_turning_them(tmp_path):
    path = written(tmp_path, np.eye(3), (0.0, 0.0, 0.0))
    # The file's axes run left, posterior, superior; turned, its first runs towards inferior, its third to the right.
    volume = read_volume(path, orientation="IPR", axes="zyx")
    np.testing.assert_array_equal(volume.labels, labels_of(block())[::-1, :, ::-1])
    assert volume.spacing == pytest.approx(SPACING)


def test_read_volume_keeps_the_voxels_whose_centres_lie_in_the_crop(tmp_path):
    path = written(tmp_path, np.eye(3), (10.0, 20.0, 30.0))
    volume = read_volume(path, crop_mm={"x": (0.5, 1.5), "z": (1.3, 100.0)})
    np.testing.assert_array_equal(volume.labels, labels_of(block())[1:4, :, 2:])
    assert volume.origin == pytest.approx((10.5, 20.0, 32.5))


@pytest.mark.parametrize(
    ("crop_mm", "message"),
    [
        (
            {"y": (100, 200)},
            r"crop_mm of y is \[100, 200\], but the voxels' centres lie every 0\.75 mm from 0 to 3\.75",
        ),
        ({"y": (0.8, 0.9)}, "none is inside"),
        ({"y": (2, 1)}, r"crop_mm of y is \(2, 1\), but it must begin before it ends"),
        ({"y": 3}, "crop_mm of y is 3, but it must be 2 finite numbers"),
        ({"w": (1, 2)}, "crop_mm is {'w'.*, but it must give"),
        ({}, "crop_mm is {}, but it must give"),
        ("y", "crop_mm is 'y', but it must give"),
    ],
)
def test_read_volume_refuses_impossible_crops(tmp_path, crop_mm, message):
    with pytest.raises(VolumeError, match=rf"turned\.nrrd: .*{message}"):
        read_volume(written(tmp_path, np.eye(3), (0.0, 0.0, 0.0)), crop_mm=crop_mm)


@pytest.mark.parametrize("orientation", ["LP", "LLS", "lps", "XYZ", "LRS", 3, ["L", "P", "S"], ""])
def test_read_volume_refuses_what_is_no_orientation(tmp_path, orientation):
    with pytest.raises(VolumeError, match=r"turned\.nrrd: orientation is"):
        read_volume(written(tmp_path, np.eye(3), (0.0, 0.0, 0.0)), orientation=orientation)


def test_manifest_turns_and_crops(tmp_path):
    written(tmp_path, np.eye(3), (0.0, 0.0, 0.0), "a.nrrd")
    written(tmp_path, np.eye(3), (0.0, 0.0, 0.0), "b.nrrd")
    (tmp_path / "manifest.yaml").write_text(
        "orientation: IPR\naxes: zyx\nvolumes: {a.nrrd: {crop_mm: {y: [0, 1]}}, b.nrrd: {orientation: null, axes: xyz}}"
    )
    volumes = open_dataset(tmp_path).volumes
    np.testing.assert_array_equal(volumes["a.nrrd"].labels, labels_of(block())[::-1, :2, ::-1])
    np.testing.assert_array_equal(volumes["b.nrrd"].labels, labels_of(block()))
