"""Pictures of an episode."""

import numpy as np
import pytest

from armscan.envs import ArmscanEnv
from armscan.envs.rendering import OPTIMUM_INK, PLANE_INK, TISSUE_INKS
from armscan.errors import ResetNeededError


def shows(picture, ink):
    return (picture == np.array(ink, dtype=np.uint8)).all(axis=-1).any()


def test_render_shows_slice_planes_and_changes_with_the_step(phantom):
    env = ArmscanEnv([phantom], projection="zy", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (480, 860, 3)
    assert first.dtype == np.uint8
    for ink in (PLANE_INK, OPTIMUM_INK, *TISSUE_INKS):
        assert shows(first, ink)
    env.step(np.array([0.2, 0.5]))
    assert (env.render() != first).any()


def test_render_needs_an_episode(phantom):
    with pytest.raises(ResetNeededError):
        ArmscanEnv([phantom], render_mode="rgb_array").render()


def test_render_without_a_mode_warns(phantom):
    env = ArmscanEnv([phantom])
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert env.render() is None
