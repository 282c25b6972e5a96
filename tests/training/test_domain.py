"""The record of an agent's training volumes, compared with other volumes."""

from dataclasses import replace

import pytest

from armscan.envs import SliceObservation, make_armscan_env
from armscan.errors import InvalidValueError
from armscan.training import TrainingDomain
from armscan.training.domain import with_crops


def test_familiar_goes_through_text_and_back(phantom):
    for observation in ("cluster", "slice"):
        domain = TrainingDomain.of(make_armscan_env([phantom], observation=observation))
        assert TrainingDomain.from_json(domain.to_json()) == domain
    assert domain.observed["slice"] == phantom.slice_shape
    assert domain.slice_px == phantom.slice_shape


def test_check_observed_says_which_part_has_another_shape(phantom):
    trained, other = (
        TrainingDomain.of(make_armscan_env([phantom], observation=SliceObservation(shape=(n, 20)))) for n in (40, 30)
    )
    trained.check_observed(trained)
    with pytest.raises(InvalidValueError, match=r"part 'slice' has the shape \(40, 20\), but .* \(30, 20\)"):
        trained.check_observed(other)


def test_differences_name_sizes_that_are_unusual(phantom):
    domain = TrainingDomain.of(make_armscan_env([phantom]))
    other = TrainingDomain({"vector": (14,)}, (100, 40), ((0.5, 0.5), (0.5, 0.5)), ((90.0, 95.0), (300.0, 900.0)))
    raw = {"_target_": "armscan.envs.ClusterObservation", "normalised": False}
    assert domain.differences(domain, raw, is_bounded=False) == []
    pixel, size = domain.differences(other, ["action_reward", raw], is_bounded=False)
    assert "0.5 mm across" in pixel
    assert "scale" in pixel
    assert "300 to 900 mm along the arm" in size
    # Bounds, and observations in mm, are the same everywhere.
    assert domain.differences(other, ["cluster", "slice_metric"], is_bounded=True) == []


def test_images_that_are_stretched_are_named(phantom):
    domain = TrainingDomain.of(make_armscan_env([phantom]))
    across, depth = domain.slice_px
    flat = replace(domain, slice_px=(across + 9, depth // 2))
    rules = {"crop": None, "shape": [48, 36]}
    told = f"an image is {depth // 2} pixels in depth (trained on {depth}): it is stretched to the same shape"
    assert domain.differences(flat, rules, is_bounded=True) == [told]
    assert domain.differences(flat, rules | {"crop": [9, 9]}, is_bounded=True) == []
    assert domain.differences(flat, "cluster", is_bounded=True) == []
    # A class of the user's own may show pixels, but only armscan's are resized.
    assert domain.differences(flat, {"_target_": "parts.Mine", "crop": None}, is_bounded=True) == []
    coarse = replace(domain, pixel_mm=((0.5, 0.5), (0.5, 0.5)))
    assert domain.differences(coarse, {"_target_": "parts.Mine"}, is_bounded=True)
    # Only where slices are smaller.
    assert with_crops(rules, domain.slice_px, flat.slice_px)["crop"] == [across, depth // 2]


def test_images_are_cropped_as_in_training():
    rules = {
        "_target_": "x",
        "observations": [{"crop": None, "shape": None}, {"crop": [9, 9], "shape": None}, "cluster"],
    }
    cropped = with_crops(rules, (30, 20), (31, 20))
    assert cropped["observations"] == [{"crop": [30, 20], "shape": None}, {"crop": [9, 9], "shape": None}, "cluster"]
    (named, _) = with_crops(["slice", "cluster"], (30, 20), (31, 20))
    assert named == {"_target_": "armscan.envs.SliceObservation", "crop": [30, 20], "shape": None}
    with pytest.raises(InvalidValueError, match=r"trained on images of 30 x 20 pixels .* 29 x 40"):
        with_crops(rules, (30, 20), (29, 40))
    assert with_crops({"crop": None, "shape": [5, 5]}, (30, 20), (29, 40)) == {"crop": [29, 20], "shape": [5, 5]}
