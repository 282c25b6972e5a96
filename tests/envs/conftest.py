"""A small volume for tests that make hundreds of environments."""

import pytest

from armscan.volumes import LabelVolume, ManipulatorAction


@pytest.fixture(scope="session")
def wrist(phantom):
    """Return the part of the phantom around its labelled plane: whole slices, but quick to copy."""
    rotation, (tx, ty) = phantom.optimal_action.rotation, phantom.optimal_action.translation
    first, stop = 240, 350
    optimum = ManipulatorAction(rotation, (tx, ty - first * phantom.spacing[1]))
    return LabelVolume(phantom.labels[:, first:stop], phantom.spacing, "wrist", optimum)
