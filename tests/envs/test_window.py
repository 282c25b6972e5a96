"""The window that shows an episode while it is played."""

import subprocess
import sys
import time

import gymnasium
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot

import armscan
from armscan.envs import ArmscanEnv
from armscan.envs.window import Window
from armscan.errors import DisplayError, ResetNeededError

PICTURE = np.arange(60 * 80 * 3, dtype=np.uint8).reshape(60, 80, 3)


@pytest.fixture
def seen(phantom, unseen_windows):
    """Yield an environment that is shown in a window, without pauses between frames."""
    env = gymnasium.make(armscan.ENV_ID, volumes=[phantom], projection="zy", render_mode="human")
    env.unwrapped._window._interval_s = 0.0
    yield env
    env.close()


def on_screen():
    (number,) = pyplot.get_fignums()
    canvas = pyplot.figure(number).canvas
    return np.asarray(canvas.buffer_rgba())[..., :3]


def test_human_shows_every_reset_and_step(seen, phantom):
    assert pyplot.get_fignums() == []
    in_array = ArmscanEnv([phantom], projection="zy", render_mode="rgb_array")
    for env in (seen, in_array):
        env.reset(seed=0)
    for _ in range(3):
        np.testing.assert_array_equal(on_screen(), in_array.render())
        for env in (seen, in_array):
            env.step(np.array([0.4, 0.5], dtype=np.float32))
    assert seen.render() is None
    assert pyplot.gcf().canvas.manager.title == "armscan"


def test_human_closes_its_window_and_opens_another(seen):
    seen.reset(seed=0)
    seen.unwrapped.close()
    assert pyplot.get_fignums() == []
    seen.unwrapped.close()
    seen.reset(seed=0)
    assert len(pyplot.get_fignums()) == 1


def test_human_goes_on_where_a_person_closes_the_window(seen):
    seen.reset(seed=0)
    pyplot.close("all")
    seen.step(np.array([0.4, 0.5], dtype=np.float32))
    seen.reset()
    assert pyplot.get_fignums() == []


def test_human_render_needs_an_episode(phantom, unseen_windows):
    with pytest.raises(ResetNeededError):
        ArmscanEnv([phantom], render_mode="human").render()


def test_window_leaves_time_to_look(unseen_windows):
    window = Window("slow", frames_per_s=5.0)
    start_s = time.monotonic()
    for _ in range(3):
        window.show(PICTURE)
    assert time.monotonic() - start_s >= 0.4
    window.close()


def test_human_without_a_display_is_refused_before_anything_is_shown(phantom):
    before = mpl.rcParams["backend"]
    pyplot.switch_backend("agg")
    try:
        with pytest.raises(DisplayError, match=r"backend is 'agg', which shows none.*needs a display"):
            ArmscanEnv([phantom], render_mode="human")
    finally:
        pyplot.switch_backend(before)


@pytest.mark.parametrize("backend", ["nonsense", "module://no.such.backend", "svg", ""])
def test_window_with_a_backend_that_shows_nothing_is_refused_in_one_line(backend):
    program = """
from armscan.envs.window import check_display
from armscan.errors import DisplayError
try:
    check_display()
except DisplayError as error:
    print(error)
"""
    environment = {"MPLBACKEND": backend, "PATH": "/usr/bin:/bin"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.startswith("no window can be opened (")
    assert done.stdout.count("\n") == 1
