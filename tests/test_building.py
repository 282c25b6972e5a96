"""What a configuration describes, built."""

from dataclasses import replace

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf, open_dict

from armscan.building import build
from armscan.training import Split


def split_of_sizes(volume):
    """A split whose test volume is narrower than the others."""
    return Split(
        {"a": replace(volume, name="a")},
        {"b": replace(volume, name="b")},
        {"c": replace(volume, name="c", labels=volume.labels[:-24])},
    )


@pytest.mark.parametrize("shape", ["null", "[40,36]"])
def test_build_crops_images_of_all_splits_alike(phantom, shape, monkeypatch):
    monkeypatch.setattr("tests.test_building.PHANTOM", phantom, raising=False)
    with initialize_config_module("armscan.conf", version_base="1.3"):
        config = compose("config", overrides=["obs=slice", f"obs.shape={shape}"])
    with open_dict(config):
        config.data = OmegaConf.create({"_target_": "tests.test_building.data"})
    experiment = build(config)
    volumes = (experiment.split.training, experiment.split.validation, experiment.split.test)
    frames = [experiment.maker.one(each).unwrapped.task._observation for each in volumes]
    assert {frame.observations[0]._frame.crop for frame in frames} == {(336, 80)}
    spaces = [experiment.maker.one(each).observation_space for each in volumes]
    assert spaces[0] == spaces[1] == spaces[2]


def data():
    return split_of_sizes(PHANTOM)  # noqa: F821 - the test's fixture
