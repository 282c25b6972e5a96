"""Arbitrary arguments: accepted if they are valid, otherwise refused by one of the project's own exceptions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armscan.anatomy import (
    METRIC_TISSUES,
    PIXEL_TISSUES,
    AgreementReward,
    LandmarkReward,
    MetricTissue,
    PixelTissue,
    TissueClusters,
    check_tissues,
    landmark_reward,
)
from armscan.errors import InvalidValueError
from tests.support.junk import SETTINGS, is_answered, junk, result_of

SLICE = np.ones((9, 7), np.uint8)


def clusters_by(tendons):
    return TissueClusters.from_slice(SLICE, PIXEL_TISSUES._replace(tendons=tendons))


@pytest.mark.parametrize("changed", ["label", "eps_px", "min_samples"])
@SETTINGS
@given(junk)
def test_pixel_tissue_with_junk(changed, value):
    tissue = result_of(lambda: PixelTissue(**{"label": 1, "eps_px": 2.0, "min_samples": 3} | {changed: value}))
    if tissue is not None:
        assert len(clusters_by(tissue).tendons) <= SLICE.size


@pytest.mark.parametrize("changed", ["label", "eps_mm", "density"])
@SETTINGS
@given(junk)
def test_metric_tissue_with_junk(changed, value):
    tissue = result_of(lambda: MetricTissue(**{"label": 1, "eps_mm": 2.0, "density": 0.5} | {changed: value}))
    if tissue is not None:
        assert is_answered(lambda: clusters_by(tissue))


@SETTINGS
@given(junk | st.tuples(*[st.floats(0.005, 1e308) | st.floats(0, 1e-6)] * 2))
def test_pixel_size_of_junk(pixel_mm):
    assert is_answered(lambda: METRIC_TISSUES.bones.neighbourhood(pixel_mm))
    assert is_answered(lambda: TissueClusters.from_slice(SLICE, METRIC_TISSUES, pixel_mm))


@SETTINGS
@given(junk)
def test_clusters_of_junk(slice_xz):
    assert is_answered(lambda: TissueClusters.from_slice(slice_xz))


@SETTINGS
@given(junk)
def test_clusters_by_junk(tissue):
    assert is_answered(lambda: clusters_by(tissue))
    assert is_answered(lambda: TissueClusters.from_slice(SLICE, tissue))
    assert is_answered(lambda: check_tissues(tissue))
    assert is_answered(lambda: check_tissues(PIXEL_TISSUES._replace(tendons=tissue)))


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0), (1, 1)])
def test_clusters_of_a_slice_without_tissue_are_none(shape):
    clusters = TissueClusters.from_slice(np.zeros(shape, np.uint8))
    assert clusters.counts == (0, 0, 0)
    assert clusters.bones.image.shape == shape
    assert landmark_reward(clusters) == -1.0


@SETTINGS
@given(junk)
def test_landmark_reward_with_junk(value):
    reward = result_of(lambda: LandmarkReward(value))
    if reward is not None:
        assert -1.0 <= reward.score(np.ones((3, 4)), (0.3, 0.5)) <= 0.0
    assert is_answered(lambda: landmark_reward(TissueClusters.from_slice(SLICE), value))
    assert result_of(lambda: landmark_reward(value)) is None


@pytest.mark.parametrize("changed", ["targets", "area_tolerance", "distance_tolerance_mm", "slack", "slack_mm"])
@SETTINGS
@given(value=junk)
def test_agreement_reward_with_junk(phantom_reward_volumes, changed, value):
    reward = result_of(lambda: AgreementReward(**{changed: value}))
    if reward is not None:
        fitted = reward.fit(phantom_reward_volumes)
        assert -1.0 <= fitted.score(np.ones((3, 4)), (0.3, 0.5)) <= 0.0


@pytest.fixture(scope="module")
def phantom_reward_volumes(phantom):
    return [phantom]


@SETTINGS
@given(value=junk)
def test_agreement_reward_fitted_to_junk(phantom, value):
    assert result_of(lambda: AgreementReward().fit(value)) is None
    assert result_of(lambda: AgreementReward().fit([phantom, value])) is None


def test_landmark_reward_says_what_clusters_are():
    with pytest.raises(InvalidValueError, match="clusters is 3, but it must be a TissueClusters"):
        landmark_reward(3)
