"""Slices against an independent implementation and against SimpleITK's resampling."""

import numpy as np
import pytest
import SimpleITK
from hypothesis import given, settings
from hypothesis import strategies as st

from armscan.errors import InvalidValueError
from armscan.volumes import LabelVolume, ManipulatorAction, RigidTransform
from armscan.volumes.slicing import BLOCK

angles_deg = st.floats(-180, 180)
shifts_mm = st.floats(-15, 25)
spacings_mm = st.floats(0.2, 1.5)


def test_slice_reproduces_every_golden_slice(dataset, golden):
    for row, name in enumerate(golden["volume"]):
        action = ManipulatorAction(tuple(golden["rotation"][row]), tuple(golden["translation"][row]))
        np.testing.assert_array_equal(dataset[str(name)].slice(action), golden[f"s{row}"], err_msg=f"row {row}")


def resampled_slice(volume, matrix, offset_mm, shape):
    """Return the slice as SimpleITK resamples it, and which pixels are far enough from a tie between two voxels."""
    image = SimpleITK.GetImageFromArray(np.ascontiguousarray(volume.labels.transpose(2, 1, 0)))
    image.SetSpacing(volume.spacing)
    plane = SimpleITK.Image([shape[0], 1, shape[1]], SimpleITK.sitkUInt8)
    plane.SetSpacing(volume.spacing)
    transform = SimpleITK.AffineTransform(3)
    transform.SetMatrix(matrix.ravel())
    transform.SetTranslation(offset_mm)
    resampled = SimpleITK.Resample(image, plane, transform, SimpleITK.sitkNearestNeighbor, 0)
    across, depth = np.meshgrid(*map(np.arange, shape), indexing="ij")
    points = np.stack([across * volume.spacing[0], np.zeros(shape), depth * volume.spacing[2]], axis=-1)
    indices = (points @ matrix.T + offset_mm) / volume.spacing
    clear = (np.abs(indices - np.floor(indices) - 0.5) > 1e-6).all(axis=-1)
    return SimpleITK.GetArrayFromImage(resampled)[:, 0, :].T, clear


@st.composite
def volumes(draw):
    shape = draw(st.tuples(*[st.integers(1, 14) | st.integers(15, 30)] * 3).filter(lambda n: np.prod(n) >= 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    labels = rng.integers(0, 5, shape)
    labels[rng.random(shape) > draw(st.sampled_from([0.01, 0.1, 1.0]))] = 0
    labels.flat[rng.choice(labels.size, 3, replace=False)] = (1, 2, 3)
    return LabelVolume(labels, draw(st.tuples(spacings_mm, spacings_mm, spacings_mm)), "random")


@settings(max_examples=150, deadline=None)
@given(
    volume=volumes(),
    rotation=st.tuples(angles_deg, angles_deg),
    translation=st.tuples(shifts_mm, shifts_mm),
    shape=st.tuples(st.integers(1, 20), st.integers(1, 20)),
)
def test_slice_equals_resampling_by_simpleitk(volume, rotation, translation, shape):
    action = ManipulatorAction(rotation, translation)
    expected, clear = resampled_slice(volume, action.matrix, action.offset_mm, shape)
    np.testing.assert_array_equal(volume.slice(action, shape)[clear], expected[clear])


@settings(max_examples=60, deadline=None)
@given(
    volume=volumes(),
    rotation=st.tuples(angles_deg, angles_deg),
    moved=st.tuples(angles_deg, angles_deg, shifts_mm, shifts_mm),
)
def test_slice_of_moved_volume_equals_resampling_through_both_maps(volume, rotation, moved):
    action = ManipulatorAction(rotation, (1.0, 2.0))
    transform = RigidTransform(moved[:2], moved[2:], volume.centre_mm)
    turn, centre = transform.matrix, np.array(volume.centre_mm)
    offset_mm = turn @ (action.offset_mm - centre) + centre + [*moved[2:], 0.0]
    expected, clear = resampled_slice(volume, turn @ action.matrix, offset_mm, volume.slice_shape)
    np.testing.assert_array_equal(volume.slice(action, transform=transform)[clear], expected[clear])


def plainly_sliced(volume, action, shape):
    """Return the slice by its definition, all pixels at once."""
    across, depth = np.meshgrid(*(np.arange(n, dtype=float) for n in shape), indexing="ij")
    places, is_inside = [], np.ones(shape, dtype=bool)
    for axis, (n_voxels, spacing) in enumerate(zip(volume.shape, volume.spacing, strict=True)):
        first = (action.matrix[axis, 0] * (across * volume.spacing[0]) + action.offset_mm[axis]) / spacing + 0.5
        place = np.floor(first + action.matrix[axis, 2] * volume.spacing[2] / spacing * depth)
        is_inside &= (place >= 0) & (place < n_voxels)
        places.append(place)
    voxels = tuple(np.where(is_inside, place, 0).astype(int) for place in places)
    return np.where(is_inside, volume.labels[voxels], 0)


@settings(max_examples=150, deadline=None)
@given(
    volume=volumes(),
    rotation=st.tuples(angles_deg, angles_deg | st.sampled_from([0.0, 90.0, 180.0, 1e-9])),
    translation=st.tuples(shifts_mm | st.just(1e12), shifts_mm),
    shape=st.tuples(st.integers(1, 20), st.integers(1, 20)),
)
def test_slice_is_what_its_definition_says_at_every_pixel(volume, rotation, translation, shape):
    action = ManipulatorAction(rotation, translation)
    np.testing.assert_array_equal(volume.slice(action, shape), plainly_sliced(volume, action, shape))


@settings(max_examples=50, deadline=None)
@given(volume=volumes())
def test_occupied_depths_hold_every_label_of_a_block_and_begin_and_end_with_one(volume):
    (n_x, n_y, n_z), depths = volume.shape, volume.occupied
    assert depths.shape == (-(-n_x // BLOCK), -(-n_y // BLOCK), 2)
    for i, j in np.ndindex(depths.shape[:2]):
        block = volume.labels[BLOCK * i : BLOCK * (i + 1), BLOCK * j : BLOCK * (j + 1)]
        shown = np.flatnonzero(block.any(axis=(0, 1)))
        assert tuple(depths[i, j]) == ((shown[0], shown[-1] + 1) if shown.size else (n_z, 0))


def test_slice_takes_the_upper_voxel_at_a_tie(tiny_volume):
    between = 6.5 * tiny_volume.spacing[1]
    np.testing.assert_array_equal(
        tiny_volume.slice(ManipulatorAction((0.0, 0.0), (0.0, between))), tiny_volume.labels[:, 7, :]
    )


def test_slice_far_outside_is_background(tiny_volume):
    assert not tiny_volume.slice(ManipulatorAction((20.0, 30.0), (1e300, -1e300))).any()


def test_slice_leaves_the_volume_as_it_was(tiny_volume):
    before = tiny_volume.labels.copy()
    tiny_volume.slice(ManipulatorAction((0.0, 0.0), (0.0, 3.0)))[:] = 9
    np.testing.assert_array_equal(tiny_volume.labels, before)


def test_slice_refuses_what_is_no_plane_and_no_transform(tiny_volume):
    with pytest.raises(InvalidValueError, match="action is None"):
        tiny_volume.slice(None)
    with pytest.raises(InvalidValueError, match="transform is 3"):
        tiny_volume.slice(ManipulatorAction((0.0, 0.0), (0.0, 0.0)), transform=3)


@pytest.mark.parametrize("shape", [(0, 3), (3,), (2.5, 3), (3, -1), 3, (True, 3), (10**9, 10**9)])
def test_slice_refuses_impossible_shape(tiny_volume, shape):
    with pytest.raises(InvalidValueError, match=r"shape (is|=)"):
        tiny_volume.slice(ManipulatorAction((0.0, 0.0), (0.0, 0.0)), shape)
