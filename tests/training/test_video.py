"""The video of an episode."""

import weakref

import numpy as np
from PIL import Image

from armscan.envs import make_armscan_env
from armscan.training import VideoRecorder, record_episode
from tests.training.test_episode_results import Still


def test_video_has_a_frame_for_the_start_and_for_every_step(phantom, tmp_path):
    env = make_armscan_env([phantom], max_steps=3, render_mode="rgb_array")
    record_episode(Still(-1.0), env, tmp_path / "episode.gif", seed=0)
    with Image.open(tmp_path / "episode.gif") as video:
        # The last two frames show the same plane, but different steps.
        assert video.n_frames == 4
        assert video.size == (860, 512)


def test_pictures_are_written_as_they_come_and_not_kept(tmp_path):
    drawn = np.random.default_rng(0)
    sizes, pictures = [], []
    with VideoRecorder(tmp_path / "a.gif", tmp_path / "a.mp4") as video:
        for _ in range(12):
            picture = drawn.integers(255, size=(64, 96, 3), dtype=np.uint8)
            pictures.append(weakref.ref(picture))
            video.add(picture)
            sizes.append((tmp_path / "a.gif").stat().st_size)
            # The one just added, and the one before.
            del picture
            assert sum(each() is not None for each in pictures) <= 2
    assert sizes[5] > 0
    assert sizes[11] > sizes[5]
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.n_frames == 12


def test_picture_that_is_the_same_again_is_a_frame_that_lasts(tmp_path):
    picture = np.full((64, 96, 3), 200, dtype=np.uint8)
    with VideoRecorder(tmp_path / "a.gif") as video:
        video.add(picture, 600)
        video.add(picture.copy(), 2400)
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.n_frames == 2
        assert [(gif.seek(number), gif.info["duration"])[1] for number in range(2)] == [600, 2400]
        assert gif.convert("RGB").getcolors() == [(64 * 96, (200, 200, 200))]
