"""Clusters against an independent implementation and against scikit-learn's DBSCAN."""

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from sklearn.cluster import DBSCAN

from armscan.anatomy import PIXEL_TISSUES, MetricTissue, TissueClusters
from armscan.anatomy.clustering import (
    bounding_boxes,
    cluster_label,
    count_disc_pixels,
    disc_half_widths,
    summarise_label,
)


def cluster_image_by_sklearn(slice_xz, label, eps, min_samples, pixel=(1.0, 1.0)):
    points = np.argwhere(slice_xz == label)
    image = np.zeros(slice_xz.shape, dtype=int)
    if len(points):
        image[tuple(points.T)] = DBSCAN(eps=eps, min_samples=min_samples).fit_predict(points * pixel) + 1
    return image


@st.composite
def slices(draw):
    """Blobs and gaps of labels, as anatomy has them, rather than pure noise."""
    shape = draw(st.tuples(st.integers(1, 40), st.integers(1, 30)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    labels = np.zeros(shape, dtype=np.uint8)
    for _ in range(draw(st.integers(0, 12))):
        centre, radius = rng.uniform(0, shape, 2), rng.uniform(0.5, 9)
        distance = np.hypot(*(np.indices(shape) - centre[:, None, None]))
        labels[distance <= radius] = rng.integers(0, 3)
    noisy = rng.random(shape) < draw(st.sampled_from([0.0, 0.05, 0.3]))
    labels[noisy] = rng.integers(0, 3, noisy.sum())
    return labels


@settings(max_examples=250, deadline=None)
@given(
    slice_xz=slices(),
    # From discs of one pixel to discs of more than 255 and more than 65,535 pixels.
    eps=st.sampled_from([0.5, 1.0, 1.1, 1.5, 2.0, 2.3, 3.0, 4.1, 5.0, 6.7, 9.3, 60.0, 150.0]),
    min_samples=st.integers(1, 50) | st.integers(200, 900),
)
@example(slice_xz=np.ones((1, 1), np.uint8), eps=1.0, min_samples=1)
def test_cluster_label_equals_sklearns_dbscan(slice_xz, eps, min_samples):
    image, centres, sizes = cluster_label(slice_xz, 1, disc_half_widths(eps), min_samples)
    expected = cluster_image_by_sklearn(slice_xz, 1, eps, min_samples)
    np.testing.assert_array_equal(image, expected)
    assert len(sizes) == expected.max(initial=0)
    for number, (centre, size) in enumerate(zip(centres, sizes, strict=True), start=1):
        points = np.argwhere(expected == number)
        assert size == len(points)
        np.testing.assert_allclose(centre, points.mean(axis=0))
    summary = np.full(4, np.nan)
    summarise_label(
        slice_xz, 1, bounding_boxes(slice_xz, np.array([1]))[0], disc_half_widths(eps), min_samples, summary
    )
    mean_centre = centres.mean(axis=0) if len(centres) else (0.0, 0.0)
    np.testing.assert_array_equal(summary, [len(sizes), sizes.sum(), *mean_centre])


@settings(max_examples=100, deadline=None)
@given(
    slice_xz=slices(),
    # No multiples of one another: scikit-learn rounds distances that equal eps up or down.
    eps_mm=st.sampled_from([0.31, 0.77, 1.63, 2.91]),
    density=st.sampled_from([0.1, 0.5, 0.62, 0.94, 1.0]),
    pixel_mm=st.tuples(st.sampled_from([0.13, 0.27, 0.55]), st.sampled_from([0.271, 0.553, 1.01])),
)
def test_metric_tissue_clusters_equal_sklearns_in_mm(slice_xz, eps_mm, density, pixel_mm):
    assume(eps_mm >= max(pixel_mm))
    half_widths, min_samples = MetricTissue(1, eps_mm, density).neighbourhood(pixel_mm)
    image, _, _ = cluster_label(slice_xz, 1, half_widths, min_samples)
    np.testing.assert_array_equal(image, cluster_image_by_sklearn(slice_xz, 1, eps_mm, min_samples, pixel_mm))
    assert min_samples == int(np.ceil(density * count_disc_pixels(half_widths)))


def test_cluster_label_gives_a_border_point_to_the_first_of_two_clusters():
    # Two solid blocks; the pixel between them has a core pixel of each within reach and too few neighbours itself.
    slice_xz = np.zeros((11, 5), np.uint8)
    slice_xz[:5] = slice_xz[6:] = 1
    slice_xz[5, 2] = 1
    image, _, _ = cluster_label(slice_xz, 1, disc_half_widths(1.1), 4)
    np.testing.assert_array_equal(image, cluster_image_by_sklearn(slice_xz, 1, 1.1, 4))


@pytest.mark.parametrize(("eps", "widths"), [(1.0, [1, 0]), (1.1, [1, 0]), (3.0, [3, 2, 2, 0]), (4.1, [4, 3, 3, 2, 0])])
def test_disc_half_widths_count_the_grid_points_of_a_disc(eps, widths):
    np.testing.assert_array_equal(disc_half_widths(eps), widths)


def test_disc_half_widths_of_oblong_pixels_describe_an_ellipse():
    # 1 mm about the middle: rows 0.4 mm apart, columns 0.3 mm apart.
    half_widths = disc_half_widths(1.0, 0.4, 0.3)
    np.testing.assert_array_equal(half_widths, [3, 3, 2])
    assert count_disc_pixels(half_widths) == 7 + 2 * 7 + 2 * 5


def test_tissue_clusters_reproduce_every_golden_image(golden):
    for row in range(len(golden["volume"])):
        clusters = TissueClusters.from_slice(golden[f"s{row}"])
        assert clusters.counts == tuple(golden["counts"][row])
        for index, tissue in enumerate(clusters.each()):
            np.testing.assert_array_equal(tissue.image, golden[f"c{row}"][index], err_msg=f"row {row}, tissue {index}")
            assert tissue.n_pixels == golden["points"][row, index]
            np.testing.assert_allclose(tissue.mean_centre, golden["centre_mean"][row, index], atol=1e-9)


def test_tissue_clusters_equal_sklearns_on_a_phantom(phantom):
    slice_xz = phantom.slice(phantom.optimal_action)
    for tissue, clusters in zip(PIXEL_TISSUES, TissueClusters.from_slice(slice_xz).each(), strict=True):
        expected = cluster_image_by_sklearn(slice_xz, tissue.label, tissue.eps_px, tissue.min_samples)
        np.testing.assert_array_equal(clusters.image, expected)


@pytest.mark.parametrize("step", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("eps_mm", [0.6, 1.2])
def test_metric_neighbourhood_is_the_same_for_spacings_of_32_bits(eps_mm, step):
    """Pixels at exactly eps are neighbours, for every way to store the spacing."""
    exact = disc_half_widths(round(eps_mm / step))
    for pixel in (step, float(np.float32(step))):
        np.testing.assert_array_equal(MetricTissue(1, eps_mm, 0.5).neighbourhood((pixel, pixel)).half_widths, exact)
