"""Measure frames rendered per second, and a step with and without rendering.

    python -m benchmarks.speed.rendering [FOLDER]

Figures are medians over many frames, each of another plane: they hold on a machine that does other things, too.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import time
from collections.abc import Callable

import numpy as np

from armscan.envs import ArmscanEnv
from benchmarks.arguments import given_volumes
from benchmarks.tables import print_head, print_row

N_FRAMES = 200


def median_seconds(env: ArmscanEnv, after_step: Callable[[], object]) -> tuple[float, float]:
    """Return the median time of a step and of what follows it."""
    steps_s, after_s = [], []
    for _ in range(N_FRAMES):
        if not env.episode.is_running:
            env.reset()
        action = env.action_space.sample()
        start_s = time.perf_counter()
        env.step(action)
        middle_s = time.perf_counter()
        after_step()
        steps_s.append(middle_s - start_s)
        after_s.append(time.perf_counter() - middle_s)
    return float(np.median(steps_s)), float(np.median(after_s))


def main() -> None:
    """Print the table."""
    env = ArmscanEnv(given_volumes(__doc__), projection="zy", render_mode="rgb_array")
    env.action_space.seed(0)
    for name in env.volumes:
        # Fonts, and the two sides of each volume, are prepared once.
        env.reset(seed=0, options={"volume": name})
        env.render()
    step_s, render_s = median_seconds(env, env.render)
    print_head("", "ms", "a second")
    for name, seconds in (("step", step_s), ("render", render_s), ("step and render", step_s + render_s)):
        print_row(name, f"{1e3 * seconds:.2f}", f"{1 / seconds:.0f}")
    print(f"\nrgb_array: {1 / render_s:.0f} frames/s")


if __name__ == "__main__":
    main()
