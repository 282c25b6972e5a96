"""The film of an episode."""

import numpy as np
from PIL import Image

from armscan.envs import make_armscan_env
from armscan.training import film_episode


class Still:
    def begin(self, *, seed, bounds):
        pass

    def act(self, observation, reward):
        return np.array([-1.0])


def test_film_has_a_frame_for_the_start_and_for_every_step(phantom, tmp_path):
    env = make_armscan_env([phantom], max_steps=3, render_mode="rgb_array")
    film_episode(Still(), env, tmp_path / "episode.gif", seed=0)
    with Image.open(tmp_path / "episode.gif") as film:
        # The last two pictures show the same plane, but another step.
        assert film.n_frames == 4
        assert film.size == (860, 512)
