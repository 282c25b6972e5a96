"""Measure environment steps per second, compared with a plain pipeline of off-the-shelf parts, in one run.

    python -m benchmarks.speed.environment [FOLDER]

Projection zy, volumes moved at each reset, the last 8 observations stacked, the best 4 actions remembered, random
actions; resets are part of the time. The plain pipeline is what one would write first: SimpleITK resamples the whole
volume with the plane's transform, a slice is cut from it, scikit-learn's DBSCAN clusters each tissue, and the same
reward is computed. It must give the same rewards as ours.

Everything is measured in turn, several times over. The figures to quote are the ratios, each the median over the
rounds: they hold on a noisy machine where milliseconds do not.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS"), "1")

import statistics
import time
from collections.abc import Callable

import gymnasium as gym
import numpy as np
import SimpleITK
from sklearn.cluster import DBSCAN

import armscan
from armscan.anatomy import PIXEL_TISSUES, Clusters, TissueClusters, landmark_reward
from armscan.envs import ManipulatorAction
from armscan.volumes import LabelVolume
from benchmarks.arguments import given_volumes
from benchmarks.tables import print_head, print_row

N_ROUNDS, N_STEPS, N_VECTOR_STEPS, N_PLAIN_STEPS = 15, 2000, 60, 2
NUM_ENVS = 64
TIMES_AS_LARGE = 8
RULES = {"projection": "zy", "rotation_bounds_deg": (90.0, 45.0), "stack": 8, "memory": 4}


def plain_reward(image: SimpleITK.Image, action: ManipulatorAction) -> float:
    """Return the reward of a plane, by off-the-shelf parts alone."""
    transform = SimpleITK.AffineTransform(3)
    transform.SetMatrix(action.matrix.ravel())
    transform.SetTranslation(action.offset_mm)
    resampled = SimpleITK.Resample(image, image, transform, SimpleITK.sitkNearestNeighbor, 0)
    slice_xz = SimpleITK.GetArrayFromImage(resampled)[:, 0, :].T
    return landmark_reward(TissueClusters(*(_clusters_by_sklearn(slice_xz, tissue) for tissue in PIXEL_TISSUES)))


def _clusters_by_sklearn(slice_xz: np.ndarray, tissue) -> Clusters:
    points = np.argwhere(slice_xz == tissue.label)
    image = np.zeros(slice_xz.shape, dtype=np.int32)
    dbscan = DBSCAN(eps=tissue.eps_px, min_samples=tissue.min_samples)
    numbers = dbscan.fit_predict(points) if len(points) else points[:, 0]
    image[tuple(points.T)] = numbers + 1
    members = [points[numbers == number] for number in range(numbers.max(initial=-1) + 1)]
    centres = np.array([member.mean(axis=0) for member in members]).reshape(-1, 2)
    return Clusters(image, centres, np.array([len(member) for member in members], dtype=np.int64))


def one_environment(volumes: dict[str, LabelVolume] | list[LabelVolume], **changes) -> Callable[[], float]:
    """Return a function that measures the seconds per step of one environment."""
    env = gym.make(armscan.ENV_ID, volumes=volumes, disable_env_checker=True, **RULES | changes)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(N_STEPS)]
    env.reset(seed=0)

    def measure() -> float:
        start_s = time.perf_counter()
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return (time.perf_counter() - start_s) / N_STEPS

    return measure


def many_environments(volumes: dict[str, LabelVolume]) -> Callable[[], float]:
    """Return a function that measures the seconds per step of one of many environments, on all cores."""
    envs = gym.make_vec(armscan.ENV_ID, num_envs=NUM_ENVS, volumes=volumes, **RULES)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(N_VECTOR_STEPS)]
    envs.reset(seed=0)

    def measure() -> float:
        n_steps, have_ended = 0, np.zeros(NUM_ENVS, dtype=np.bool_)
        start_s = time.perf_counter()
        for batch in actions:
            _, _, terminated, truncated, _ = envs.step(batch)
            # After the end of an episode, the next call only resets its environment.
            n_steps += int((~have_ended).sum())
            have_ended = terminated | truncated
        return (time.perf_counter() - start_s) / n_steps

    return measure


def plain_pipeline(volume: LabelVolume) -> Callable[[], float]:
    """Return a function that measures the plain pipeline's seconds per plane, and checks that it gives our rewards."""
    image = SimpleITK.GetImageFromArray(np.ascontiguousarray(volume.labels.transpose(2, 1, 0)))
    image.SetSpacing(volume.spacing)
    rng = np.random.default_rng(0)
    spread = np.array([20.0, 5.0, 5.0, 20.0])

    def measure() -> float:
        optimum = volume.optimal_action.to_array()
        actions = [ManipulatorAction.from_array(optimum + rng.uniform(-spread, spread)) for _ in range(N_PLAIN_STEPS)]
        start_s = time.perf_counter()
        rewards = [plain_reward(image, action) for action in actions]
        elapsed_s = time.perf_counter() - start_s
        ours = [landmark_reward(TissueClusters.from_slice(volume.slice(action))) for action in actions]
        np.testing.assert_array_equal(rewards, ours)
        return elapsed_s / N_PLAIN_STEPS

    return measure


def larger(volume: LabelVolume) -> LabelVolume:
    """Return the same arm several times over, end to end: slices of the same size through a far larger volume."""
    labels = np.tile(volume.labels, (1, TIMES_AS_LARGE, 1))
    return LabelVolume(labels, volume.spacing, f"{TIMES_AS_LARGE} x {volume.name}", volume.optimal_action)


def main() -> None:
    """Print the table."""
    volumes = given_volumes(__doc__)
    first = next(iter(volumes.values()))
    one, plain = "one environment, one core", "SimpleITK and scikit-learn"
    measures = {
        one: one_environment(volumes),
        f"{NUM_ENVS} environments side by side, {os.cpu_count()} cores": many_environments(volumes),
        "one, slice_channels at full size, no stack": one_environment(
            volumes, observation="slice_channels", stack=1, memory=0
        ),
        "one, slice_channels at full size, stack and memory": one_environment(volumes, observation="slice_channels"),
        "one, slice_metric at 60 x 40, no stack": one_environment(
            volumes, observation="slice_metric", stack=1, memory=0
        ),
        "one, on a single volume": one_environment([first]),
        f"one, on that volume {TIMES_AS_LARGE} times as large": one_environment([larger(first)]),
        plain: plain_pipeline(first),
    }
    for measure in measures.values():
        measure()
    rounds = [{name: measure() for name, measure in measures.items()} for _ in range(N_ROUNDS)]
    print_head("", "steps/s, median", "best", "beside one environment")
    for name in measures:
        seconds = [measured[name] for measured in rounds]
        ratio = statistics.median(measured[one] / measured[name] for measured in rounds)
        shown = f"{ratio:.2f}" if ratio > 0.1 else f"1/{1 / ratio:.0f}"
        print_row(name, f"{1 / statistics.median(seconds):,.0f}", f"{1 / min(seconds):,.0f}", shown)
    print("\nthe plain pipeline gave the same rewards")


if __name__ == "__main__":
    main()
