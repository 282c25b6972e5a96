"""Volumes of different spacing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armscan.errors import VolumeError
from armscan.volumes import LabelVolume, ManipulatorAction, open_dataset
from armscan.volumes.resampling import finest_spacing, resample
from tests.conftest import make_tiny_volume


def random_volume(shape, spacing):
    labels = np.random.default_rng(0).integers(0, 5, shape).astype(np.uint8)
    labels.flat[:3] = (1, 2, 3)
    return LabelVolume(labels, spacing, "wrist")


@settings(max_examples=30, deadline=None)
@given(
    shape=st.tuples(*[st.integers(1, 8)] * 3).filter(lambda shape: np.prod(shape) >= 3),
    spacing=st.tuples(*[st.floats(0.1, 3.0)] * 3),
    factors=st.tuples(*[st.floats(0.2, 1.0)] * 3),
)
def test_resampled_gives_each_voxel_the_nearest_label_and_keeps_the_frame(shape, spacing, factors):
    volume = random_volume(shape, spacing)
    wanted = tuple(step * factor for step, factor in zip(spacing, factors, strict=True))
    finer = resample(volume, wanted)
    if np.allclose(finer.spacing, volume.spacing, rtol=1e-5):
        return
    positions = np.argwhere(np.ones(finer.shape, bool)) * np.array(wanted) / np.array(spacing)
    # Where two voxels are equally near, either will do.
    clear = (np.abs(positions % 1 - 0.5) > 1e-3).all(axis=1)
    nearest = np.floor(positions + 0.5).astype(int)[clear]
    np.testing.assert_array_equal(finer.labels.reshape(-1)[clear], volume.labels[tuple(nearest.T)])
    extents = (np.array(finer.shape) - 1) * wanted
    assert (extents < (np.array(shape) - 0.5) * spacing).all()
    assert (extents + wanted > (np.array(shape) - 0.5) * spacing - 1e-5).all()
    assert (finer.origin, finer.direction.tolist()) == (volume.origin, volume.direction.tolist())


def test_resampled_leaves_a_volume_of_that_spacing_alone():
    volume = make_tiny_volume()
    assert resample(volume, (0.5, 0.7, 0.9000001)) is volume


def test_resampled_shows_the_same_on_a_plane():
    volume = make_tiny_volume()
    finer = resample(volume, (0.25, 0.7, 0.3))
    action = ManipulatorAction((10.0, 5.0), (1.0, 5.0))
    seen, seen_finer = volume.slice(action), finer.slice(action)
    assert (seen == seen_finer[::2, ::3][: seen.shape[0], : seen.shape[1]]).mean() > 0.95


@pytest.mark.parametrize("spacing", [(1e-6, 1e-6, 1e-6), (1e-9, 1e6, 1e6), (1e-200, 1e200, 1e200), (5e-324, 1.0, 1.0)])
def test_resampled_refuses_what_no_machine_holds(spacing):
    with pytest.raises(VolumeError, match=r"wrist: resampled from .* it would have .* voxels, but"):
        resample(random_volume((8, 8, 8), (1.0, 1.0, 1.0)), spacing)


@pytest.mark.parametrize(
    ("spacing", "expected"), [("own", False), ("finest", True), ("[0.3, 0.4, 0.5]", True), ("[0.2, 0.4, 0.5]", False)]
)
def test_manifest_brings_volumes_to_one_spacing(write_labelmap, tmp_path, spacing, expected):
    write_labelmap("a.nrrd", spacing=(0.3, 0.5, 0.5, 1.0))
    write_labelmap("b.nrrd", spacing=(0.4, 0.4, 0.6, 1.0))
    (tmp_path / "manifest.yaml").write_text(f"spacing: {spacing}")
    dataset = open_dataset(tmp_path)
    spacings = {volume.spacing for volume in dataset.volumes.values()}
    assert (spacings == {(0.3, 0.4, 0.5)}) == expected
    assert {report.volume.spacing for report in dataset.reports.values()} == spacings
    assert dataset.reports["b.nrrd"].stored.spacing == pytest.approx((0.4, 0.4, 0.6))
    if expected:
        assert finest_spacing(dataset.volumes.values()) == (0.3, 0.4, 0.5)
