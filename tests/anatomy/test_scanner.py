"""One look at a plane, alone and many at once."""

import pickle

import numpy as np
import pytest

from armscan.anatomy import METRIC_TISSUES, PIXEL_TISSUES, Scanner, TissueClusters
from armscan.volumes import LabelVolume, ManipulatorAction


@pytest.fixture(scope="module")
def volumes(dataset):
    """Volumes of different sizes and spacings."""
    first, second = list(dataset.values())[:2]
    finer = first.labels[:, 350:600].repeat(2, axis=0)
    s_x, s_y, s_z = first.spacing
    return [second, LabelVolume(finer, (s_x / 2, s_y, s_z), "finer", first.optimal_action)]


def drawn_planes(volumes, n_planes):
    rng = np.random.default_rng(0)
    which = rng.integers(len(volumes), size=n_planes)
    planes = [ManipulatorAction(rng.uniform(-60, 60, 2), rng.uniform(0, volumes[place].size_mm[:2])) for place in which]
    return which, planes


@pytest.mark.parametrize("tissues", [PIXEL_TISSUES, METRIC_TISSUES], ids=["pixels", "metric"])
def test_scanner_sees_what_slices_and_clusters_show(volumes, tissues):
    scanner = Scanner(volumes, tissues)
    n_clusters = 0
    for place, plane in zip(*drawn_planes(volumes, 40), strict=True):
        slice_xz, landmarks = scanner.look(place, plane)
        np.testing.assert_array_equal(slice_xz, volumes[place].slice(plane))
        clusters = TissueClusters.from_slice(slice_xz, tissues, volumes[place].pixel_mm)
        np.testing.assert_array_equal(landmarks, clusters.landmarks)
        n_clusters += landmarks[:, 0].sum()
    assert n_clusters > 50


def test_scanner_gives_the_same_for_many_planes_at_once(volumes):
    scanner = pickle.loads(pickle.dumps(Scanner(volumes, PIXEL_TISSUES)))
    which, planes = drawn_planes(volumes, 30)
    maps = np.empty((len(planes), 0, 3, 4))
    slices, landmarks = scanner.look_all(which, np.array([plane.to_array() for plane in planes]), maps)
    for i, (place, plane) in enumerate(zip(which, planes, strict=True)):
        alone_xz, alone = scanner.look(place, plane)
        np.testing.assert_array_equal(slices[i], alone_xz)
        np.testing.assert_array_equal(landmarks[i], alone)
