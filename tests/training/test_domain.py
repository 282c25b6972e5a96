"""The record of an agent's training volumes, compared with other volumes."""

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
    assert domain.differences(domain) == []
    assert any("0.5 mm across" in note and "scale" in note for note in domain.differences(other))
    assert any("300 to 900 mm along the arm" in note for note in domain.differences(other))


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
    assert with_crops({"crop": None, "shape": [5, 5]}, (30, 20), (29, 40)) == {"crop": None, "shape": [5, 5]}
