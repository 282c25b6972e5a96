"""The slice as an image in millimetres."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armscan.anatomy import PIXEL_TISSUES
from armscan.envs import ArmscanEnv, MetricSliceObservation, SliceGeometry, View
from armscan.errors import InvalidValueError
from armscan.volumes import LabelVolume

FULL = 255


def observed(slice_xz, slice_pixel_mm, **arguments):
    """Return the image of a slice, and check it against its space."""
    slice_xz = np.asarray(slice_xz, dtype=np.uint8)
    geometry = SliceGeometry(slice_xz.shape, slice_pixel_mm)
    view = View(slice_xz, np.zeros((3, 4)), PIXEL_TISSUES, geometry, slice_xz.shape, action=np.zeros(1), reward=-1.0)
    observation = MetricSliceObservation(**arguments)
    image = observation.observe(view)["shares"]
    assert observation.spaces([geometry], 1)["shares"].contains(image)
    return image


def reference(slice_xz, pixel_mm, field_mm, image_pixel_mm):
    """Compute the image slowly: by the overlap of each pixel of the slice with each pixel of the image."""
    shape = [round(field / pixel) for field, pixel in zip(field_mm, image_pixel_mm, strict=True)]
    weights = []
    for axis in (0, 1):
        n, m, size, pixel = slice_xz.shape[axis], shape[axis], pixel_mm[axis], image_pixel_mm[axis]
        common = np.zeros((m, n))
        for row, i in np.ndindex(m, n):
            low = max((row - m / 2) * pixel, (i - n / 2) * size)
            high = min((row + 1 - m / 2) * pixel, (i + 1 - n / 2) * size)
            common[row, i] = max(0.0, high - low) / pixel
        weights.append(common)
    return np.stack([weights[0] @ (slice_xz == label) @ weights[1].T for label in (1, 2, 3)]) * FULL


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_pixels_are_means_over_their_area(data):
    sides = st.integers(1, 13)
    sizes = st.floats(0.1, 3.0)
    slice_xz = np.random.default_rng(data.draw(st.integers(0, 2**32))).integers(
        5, size=(data.draw(sides), data.draw(sides)), dtype=np.uint8
    )
    pixel_mm = data.draw(sizes), data.draw(sizes)
    image_pixel_mm = data.draw(sizes), data.draw(sizes)
    field_mm = data.draw(sides) * image_pixel_mm[0], data.draw(sides) * image_pixel_mm[1]
    image = observed(slice_xz, pixel_mm, field_of_view_mm=field_mm, pixel_mm=image_pixel_mm)
    assert np.abs(image - reference(slice_xz, pixel_mm, field_mm, image_pixel_mm)).max() <= 0.51


def test_the_image_does_not_depend_on_the_spacing():
    coarse = np.random.default_rng(0).integers(5, size=(30, 20), dtype=np.uint8)
    fine = coarse.repeat(3, axis=0).repeat(2, axis=1)
    one, other = observed(coarse, (0.9, 1.0)), observed(fine, (0.3, 0.5))
    assert np.abs(one.astype(int) - other).max() <= 1
    assert one.any()


def test_nothing_lies_beside_the_slice_which_is_in_the_middle():
    image = observed(np.ones((4, 2)), (1.0, 1.0), field_of_view_mm=(8.0, 4.0), pixel_mm=(1.0, 1.0))
    expected = np.zeros((3, 8, 4))
    expected[0, 2:6, 1:3] = FULL
    np.testing.assert_array_equal(image, expected)


def test_environments_on_volumes_of_different_spacing_show_the_same(wrist):
    fine = LabelVolume(
        wrist.labels.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2),
        tuple(size / 2 for size in wrist.spacing),
        "fine",
        # The first voxel's centre lies a quarter of a voxel nearer to the corner.
        wrist.optimal_action,
    )
    images = []
    for each in (wrist, fine):
        env = ArmscanEnv(
            [each],
            observation=MetricSliceObservation(),
            transform=None,
            projection="full",
            clustering="metric",
            success_threshold=1.0,
        )
        images.append(env.reset(seed=0)[0]["shares"].astype(float) / FULL)
    # The grids differ by a quarter of a voxel, a small part of a pixel.
    assert np.abs(images[0] - images[1]).mean() < 0.01
    assert images[0].sum() > 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"pixel_mm": (1.0, 0.0)}, "each of pixel_mm"),
        ({"pixel_mm": (1.0,)}, "pixel_mm"),
        ({"field_of_view_mm": (10.5, 4.0), "pixel_mm": (1.0, 1.0)}, "10.5 x 4 pixels"),
        ({"field_of_view_mm": (10.0, 4.0), "pixel_mm": (1e-3, 1.0)}, "10000 x 4 pixels"),
        ({"field_of_view_mm": (1.0, 4.0), "pixel_mm": (100.0, 1.0)}, "0.01 x 4 pixels"),
    ],
)
def test_impossible_sizes_are_refused(arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        MetricSliceObservation(**arguments)
