"""The slice as an observation: cropped, reduced, repeated, as labels and as channels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armscan.anatomy import PIXEL_TISSUES
from armscan.envs import ArmscanEnv, SliceChannelsObservation, SliceGeometry, SliceObservation, View
from armscan.errors import InvalidValueError

# If several labels fall into a reduced pixel, it shows the first of these that is among them.
RAREST_FIRST = (3, 4, 2, 1, 0)
KINDS = {SliceObservation: "slice", SliceChannelsObservation: "channels"}


def view_of(slice_xz, smallest=None):
    slice_xz = np.asarray(slice_xz, dtype=np.uint8)
    return View(
        slice_xz=slice_xz,
        landmarks=np.zeros((3, 4)),
        tissues=PIXEL_TISSUES,
        geometry=SliceGeometry(slice_xz.shape, (0.27, 0.55)),
        smallest_shape=smallest or slice_xz.shape,
        action=np.zeros(1),
        reward=-1.0,
    )


def observed(kind, slice_xz, smallest=None, **arguments):
    """Return what is observed of a slice, and check it against its space."""
    view = view_of(slice_xz, smallest)
    observation = kind(**arguments)
    geometries = [view.geometry, SliceGeometry(view.smallest_shape, (0.3, 0.3))]
    part = observation.observe(view)[KINDS[kind]]
    assert observation.spaces(geometries, 1)[KINDS[kind]].contains(part)
    return part


def pixels_of(pixel, n, wanted):
    """Return which of n pixels fall into a pixel, given by its index among `wanted` ones."""
    return [i for i in range(n) if i + 1 > pixel * n / wanted and i < (pixel + 1) * n / wanted]


def reference(slice_xz, crop, shape):
    """Compute slowly what `SliceObservation` shows."""
    first = [int(np.ceil((n - wanted) / 2)) for n, wanted in zip(slice_xz.shape, crop, strict=True)]
    cropped = slice_xz[first[0] :, first[1] :][: crop[0], : crop[1]]
    reduced = np.zeros(shape, dtype=int)
    for pixel in np.ndindex(shape):
        rows, cols = (pixels_of(pixel[axis], crop[axis], shape[axis]) for axis in (0, 1))
        reduced[pixel] = min(cropped[np.ix_(rows, cols)].ravel(), key=RAREST_FIRST.index)
    return reduced


def channels_reference(slice_xz, crop, shape):
    """Compute slowly what `SliceChannelsObservation` shows: each tissue as if there were no other."""
    return np.stack([reference(np.where(slice_xz == tissue, 3, 0), crop, shape) // 3 for tissue in (1, 2, 3)])


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_slices_are_cropped_and_reduced_as_the_slow_reference_does(data):
    sides = st.tuples(st.integers(1, 13), st.integers(1, 13))
    n_across, n_depth = data.draw(sides)
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    slice_xz = rng.choice(5, size=(n_across, n_depth), p=[0.6, 0.1, 0.1, 0.1, 0.1]).astype(np.uint8)
    crop = data.draw(st.tuples(st.integers(1, n_across), st.integers(1, n_depth)))
    shape = data.draw(st.none() | sides)
    expected = reference(slice_xz, crop, shape or crop), channels_reference(slice_xz, crop, shape or crop)
    np.testing.assert_array_equal(observed(SliceObservation, slice_xz, crop=crop, shape=shape), expected[0])
    np.testing.assert_array_equal(observed(SliceChannelsObservation, slice_xz, crop=crop, shape=shape), expected[1])


@pytest.mark.parametrize(
    ("n", "crop", "kept"),
    [(5, 5, [0, 1, 2, 3, 4]), (5, 3, [1, 2, 3]), (5, 4, [1, 2, 3, 4]), (4, 1, [2]), (5, 2, [2, 3]), (4, 2, [1, 2])],
)
def test_slice_crop_takes_the_larger_half_of_an_odd_surplus_from_the_low_side(n, crop, kept):
    ramp = np.arange(n) % 5
    np.testing.assert_array_equal(observed(SliceObservation, ramp[:, None], crop=(crop, 1))[:, 0], ramp[kept])
    np.testing.assert_array_equal(observed(SliceObservation, ramp[None, :], crop=(1, crop))[0], ramp[kept])


def test_slices_of_different_volumes_are_cropped_to_the_smallest():
    wide = np.zeros((6, 4))
    wide[2:5, 1:3] = 1
    np.testing.assert_array_equal(observed(SliceObservation, wide, smallest=(3, 2)), np.ones((3, 2)))


@pytest.mark.parametrize("label", [1, 2, 3, 4])
@settings(max_examples=10, deadline=None)
@given(pixel=st.tuples(st.integers(0, 360), st.integers(0, 80)))
def test_slice_reduction_keeps_single_pixels_visible(label, pixel):
    slice_xz = np.zeros((361, 81))
    slice_xz[pixel] = label
    assert (observed(SliceObservation, slice_xz, shape=(24, 20)) == label).any()
    if label <= 3:
        channels = observed(SliceChannelsObservation, slice_xz, shape=(24, 20))
        assert channels.any(axis=(1, 2)).tolist() == [tissue == label for tissue in (1, 2, 3)]


@pytest.mark.parametrize(
    ("labels", "shown"), [([0, 1], 1), ([1, 2], 2), ([1, 2, 4], 4), ([4, 3], 3), ([0, 1, 2, 3, 4], 3), ([0, 4], 4)]
)
def test_slice_reduction_shows_the_rarest_tissue(labels, shown):
    assert observed(SliceObservation, [labels], shape=(1, 1)) == shown
    np.testing.assert_array_equal(
        observed(SliceChannelsObservation, [labels], shape=(1, 1)).ravel(), np.isin([1, 2, 3], labels)
    )


def test_slice_enlargement_repeats_pixels():
    small = [[1, 2], [3, 4]]
    np.testing.assert_array_equal(observed(SliceObservation, small, shape=(4, 6)), np.kron(small, np.ones((2, 3))))


def test_slice_channels_are_the_landmark_tissues():
    channels = observed(SliceChannelsObservation, [[0, 1, 2, 3, 4]])
    np.testing.assert_array_equal(channels[:, 0], [[0, 1, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0]])


@pytest.mark.parametrize("kind", KINDS)
def test_slice_observation_is_a_copy(kind):
    view = view_of(np.ones((4, 5)))
    kind().observe(view)[KINDS[kind]][:] = 0
    assert view.slice_xz.all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("crop", [(7, 5), (6, 6)])
def test_slice_crop_larger_than_a_slice_is_refused(kind, crop):
    geometries = [SliceGeometry((9, 5), (1.0, 1.0)), SliceGeometry((6, 8), (1.0, 1.0))]
    with pytest.raises(InvalidValueError, match=r"crop is .* at most \(6, 5\), which fits"):
        kind(crop=crop).spaces(geometries, 1)
    kind(crop=(6, 5)).spaces(geometries, 1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("argument", ["crop", "shape"])
@pytest.mark.parametrize("wrong", [(0, 1), (1,), (1, 2, 3), "ab", 5, (1.5, 2), (True, 1), (10**9, 1), {1: 2, 3: 4}])
def test_slice_observation_refuses_impossible_shapes(kind, argument, wrong):
    with pytest.raises(InvalidValueError, match=f"{argument} is"):
        kind(**{argument: wrong})


@pytest.mark.parametrize("kind", KINDS)
def test_slice_observation_is_of_the_environments_slice(wrist, kind):
    env = ArmscanEnv([wrist], observation=kind())
    seen, _ = env.reset(seed=0)
    np.testing.assert_array_equal(seen[KINDS[kind]], observed(kind, env.slice_xz))
