"""Clustering of tissues, in pixels and in millimetres."""

import pytest

from armscan.anatomy import (
    METRIC_TISSUES,
    PIXEL_TISSUES,
    MetricTissue,
    PixelTissue,
    TissueClusters,
    check_tissues,
    landmark_reward,
)
from armscan.errors import InvalidValueError


@pytest.mark.parametrize(("eps_px", "min_samples"), [(0.0, 4), (-1.0, 4), (float("nan"), 4), (1.0, 0), (1.0, 2.5)])
def test_pixel_tissue_refuses_impossible_clustering(eps_px, min_samples):
    with pytest.raises(InvalidValueError, match="of label 1 is"):
        PixelTissue(1, eps_px, min_samples)


@pytest.mark.parametrize(("eps_mm", "density"), [(0.0, 0.5), (float("inf"), 0.5), (1.0, 0.0), (1.0, 1.1), ("a", 0.5)])
def test_metric_tissue_refuses_impossible_clustering(eps_mm, density):
    with pytest.raises(InvalidValueError, match="of label 1 is"):
        MetricTissue(1, eps_mm, density)


@pytest.mark.parametrize("pixel_mm", [(0.0, 1.0), (1.0, -1.0), (1.0,), "ab"])
def test_metric_tissue_refuses_impossible_pixels(pixel_mm):
    with pytest.raises(InvalidValueError, match="pixel_mm is"):
        MetricTissue(1, 1.0, 0.5).neighbourhood(pixel_mm)


@pytest.mark.parametrize("pixel_mm", [(0.27, 0.7), (0.7, 0.27)])
def test_metric_tissue_refuses_pixels_without_neighbours(pixel_mm):
    with pytest.raises(InvalidValueError, match=r"eps_mm of label 3 is 0\.6, .* must be at least 0\.7"):
        METRIC_TISSUES.artery.neighbourhood(pixel_mm)


def test_metric_clusters_score_labelled_planes_at_every_spacing(dataset):
    """One setting serves all: labelled planes seen with finer and with coarser pixels, up to 0.55 mm."""
    for volume in dataset.values():
        labelled = volume.slice(volume.optimal_action)
        across_mm, depth_mm = volume.pixel_mm
        seen = [(labelled[::2], (2 * across_mm, depth_mm))]
        for across, depth in ((1, 1), (2, 2), (3, 2), (1, 2)):
            finer = labelled.repeat(across, axis=0).repeat(depth, axis=1)
            seen.append((finer, (across_mm / across, depth_mm / depth)))
        for slice_xz, pixel_mm in seen:
            clusters = TissueClusters.from_slice(slice_xz, METRIC_TISSUES, pixel_mm)
            assert landmark_reward(clusters) > -0.05, (volume.name, pixel_mm, clusters.counts)


def test_check_tissues_takes_names_and_tissues():
    assert check_tissues("pixels") is PIXEL_TISSUES
    assert check_tissues(METRIC_TISSUES) is METRIC_TISSUES
    for wrong in ("mm", 3, None, [1, 2, 3]):
        with pytest.raises(InvalidValueError, match="clustering is"):
            check_tissues(wrong)
