"""How long one environment step takes, beside a plain pipeline of public parts, in one run on one core.

    python -m benchmarks.env_step [FOLDER]

The plain pipeline is what one would write first: SimpleITK resamples the whole volume with the plane's transform, a
slice is cut from it, scikit-learn's DBSCAN clusters each tissue, and the same reward is computed. Both see the same
planes and must give the same rewards. The figure to quote is the ratio: it holds on a noisy machine where milliseconds
do not.
"""

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS"):
    os.environ[_variable] = "1"

import sys
import time
from pathlib import Path

import numpy as np
import SimpleITK
from sklearn.cluster import DBSCAN

from armscan.anatomy import PIXEL_TISSUES, Clusters, TissueClusters, landmark_reward
from armscan.envs import ArmscanEnv, ManipulatorAction
from armscan.volumes import LabelVolume, read_dataset

DEFAULT_FOLDER = Path(__file__).parent.parent / "tests" / "data" / "volumes"
N_STEPS, N_PLAIN_STEPS = 4000, 8


def plain_reward(image: SimpleITK.Image, action: ManipulatorAction) -> float:
    """The reward of a plane, by public parts alone."""
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


def seconds_a_step(volumes: dict[str, LabelVolume]) -> float:
    """Our environment, resets included: projection zy, transforms on, cluster observation."""
    env = ArmscanEnv(volumes, projection="zy")
    env.action_space.seed(0)
    env.reset(seed=0)
    start_s = time.perf_counter()
    for _ in range(N_STEPS):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    return (time.perf_counter() - start_s) / N_STEPS


def seconds_a_plain_step(volume: LabelVolume) -> float:
    """The plain pipeline, without an environment around it; checks that it gives our rewards."""
    assert volume.optimal_action is not None
    image = SimpleITK.GetImageFromArray(np.ascontiguousarray(volume.labels.transpose(2, 1, 0)))
    image.SetSpacing(volume.spacing)
    rng = np.random.default_rng(0)
    spread = np.array([20.0, 5.0, 5.0, 20.0])
    optimum = volume.optimal_action.to_array()
    actions = [ManipulatorAction.from_array(optimum + rng.uniform(-spread, spread)) for _ in range(N_PLAIN_STEPS)]
    start_s = time.perf_counter()
    rewards = [plain_reward(image, action) for action in actions]
    elapsed_s = time.perf_counter() - start_s
    ours = [landmark_reward(TissueClusters.from_slice(volume.slice(action))) for action in actions]
    np.testing.assert_allclose(rewards, ours, atol=1e-12)
    return elapsed_s / N_PLAIN_STEPS


def main() -> None:
    """Prints the table."""
    volumes = read_dataset(sys.argv[1] if len(sys.argv) > 1 else DEFAULT_FOLDER)
    ours_s, plain_s = seconds_a_step(volumes), seconds_a_plain_step(next(iter(volumes.values())))
    print("| pipeline | ms a step | steps/s |\n| --- | --- | --- |")
    for name, seconds in (("armscan", ours_s), ("SimpleITK and scikit-learn", plain_s)):
        print(f"| {name} | {1e3 * seconds:.2f} | {1 / seconds:.0f} |")
    print(f"\narmscan is {plain_s / ours_s:.0f} times faster; both give the same rewards.")


if __name__ == "__main__":
    main()
