"""Objects built from a configuration."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from armscan.config.compose import compose
from armscan.envs import SliceObservation
from armscan.errors import InvalidValueError
from armscan.experiment.build import build_setup, set_up
from armscan.training import Split


def split_of_sizes(volume):
    """Return a split whose test volume is narrower than the others."""
    return Split(
        {"a": replace(volume, name="a")},
        {"b": replace(volume, name="b", labels=np.roll(volume.labels, 1, axis=2))},
        {"c": replace(volume, name="c", labels=volume.labels[:-24])},
    )


class AsLargeAsTheSlice(SliceObservation):
    """A user's own observation, without a crop that could be the same everywhere."""

    def __init__(self):
        super().__init__()


def config_of_sizes(phantom, monkeypatch, *overrides):
    """Return the configuration with volumes of which the test volume is narrower."""
    monkeypatch.setattr("armscan.training.phantom_data", lambda **_: split_of_sizes(phantom))
    return compose(overrides)


@pytest.mark.parametrize(
    "overrides",
    [
        ["obs=slice", "obs.shape=null"],
        ["obs=slice", "obs.shape=[40,36]"],
        ["env.observation=slice"],
        ["env.observation=[slice_channels,slice]"],
    ],
    ids=str,
)
def test_build_crops_images_of_all_splits_alike(phantom, overrides, monkeypatch):
    experiment = build_setup(config_of_sizes(phantom, monkeypatch, *overrides))
    volumes = (experiment.split.training, experiment.split.validation, experiment.split.test)
    frames = [experiment.env_factory.make_env(each).unwrapped.rules._observation for each in volumes]
    assert {frame.observations[0]._crop for frame in frames} == {(336, 80)}
    spaces = [experiment.env_factory.make_env(each).observation_space for each in volumes]
    assert spaces[0] == spaces[1] == spaces[2]


def test_stage_refuses_volumes_that_an_observation_is_of_another_shape_on(phantom, monkeypatch):
    own = "env.observation={_target_: tests.experiment.test_build.AsLargeAsTheSlice}"
    config = config_of_sizes(phantom, monkeypatch, own)
    with pytest.raises(InvalidValueError, match=r"part 'slice' has the shape \(360, 80\), but .* \(336, 80\)"):
        set_up(config)


def test_agent_of_vectors_computes_on_the_cpu_beside_a_gpu(phantom, monkeypatch):
    config = config_of_sizes(phantom, monkeypatch)
    monkeypatch.setattr("armscan.agents.compute._has_cuda", lambda: True)
    assert build_setup(config).agent.update_note == "compiled"


class Unfinished:
    """A user's own algorithm and agent, which learns but has no policy."""

    def agent(self, setup):
        return self

    def begin(self, *, seed, bounds):
        pass

    def act(self, observation, reward):
        return [0.0]

    def learn(self, n_env_steps):
        return {}


def test_build_refuses_an_agent_that_learns_but_lacks_what_training_needs(phantom, monkeypatch):
    config = config_of_sizes(phantom, monkeypatch)
    config.agent = {"_target_": "tests.experiment.test_build.Unfinished"}
    with pytest.raises(
        InvalidValueError, match=r"agent is Unfinished, which learns, .* has no .*policy, weights,.* or load_state"
    ):
        build_setup(config)


def test_own_code_is_that_which_runs_if_its_file_is_edited_while_volumes_are_read(phantom, monkeypatch, tmp_path):
    module = tmp_path / "own_agent_edited.py"
    module.write_text("from armscan.agents import Random\n\n\nclass Own(Random):\n    pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))

    def read_slowly(**_):
        module.write_text("")
        return split_of_sizes(phantom)

    monkeypatch.setattr("armscan.training.phantom_data", read_slowly)
    expected = hashlib.sha256(module.read_bytes()).hexdigest()
    own_code = build_setup(compose(["agent=random", "agent._target_=own_agent_edited.Own"])).own_code
    assert not module.read_text()
    assert expected.startswith(own_code["own_agent_edited"])


@pytest.mark.parametrize("section", ["data", "training", "compute"])
def test_section_that_builds_something_else_is_refused(phantom, monkeypatch, section):
    config = config_of_sizes(phantom, monkeypatch)
    config[section] = {}
    with pytest.raises(InvalidValueError, match=f"^{section} builds {{}}, but it must build a "):
        build_setup(config)


@pytest.mark.parametrize("made", [None, "sac", dict])
def test_algorithm_that_makes_no_agent_is_refused(phantom, monkeypatch, made):
    config = config_of_sizes(phantom, monkeypatch, "agent=random")
    monkeypatch.setattr("armscan.agents.Random.agent", lambda *_: made)
    with pytest.raises(InvalidValueError, match=r"Random.agent returned .*, but it must return an object with"):
        build_setup(config)
