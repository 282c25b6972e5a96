"""Measure memory and time of the replay buffer of image observations against a plain one, in one run.

    python -m benchmarks.speed.replay [FOLDER]

Channels of 84 x 84, a stack of 4, the best 4 actions. In short episodes, actions are often so near the optimum that an
episode takes some two steps. In long ones, actions are always next to it, where slices show much, and many episodes
take all 50 steps. Of each kind, 10,000 transitions are played, and added repeatedly until the buffer is full;
repetitions share no frame. Memory is the growth of the process. The plain buffer is measured with fewer transitions,
and scaled.

A sampling is all that an update of SAC reads: a batch, and its next observations once more. Both buffers are sampled in
turn and must return the same.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"

import ctypes
import gc
import multiprocessing
import statistics
import sys
import time
from collections.abc import Iterable, Mapping
from itertools import cycle, islice
from pathlib import Path

import numpy as np
from tianshou.data import Batch

from armscan.agents.image_replay import replay_for
from armscan.agents.replay import Replay
from armscan.envs import EnvFactory, SliceChannelsObservation
from armscan.volumes import LabelVolume
from benchmarks.arguments import given_volumes
from benchmarks.tables import print_head, print_row

N_ENVS, N_PLAYED, N_PLAIN, N_TRANSITIONS = 16, 10_000, 20_000, 1_000_000
BATCH_SIZE, N_ROUNDS = 256, 101
RULES = {"projection": "zy", "rotation_bounds_deg": (90.0, 45.0), "stack": 4, "memory": 4}
# Share of actions near the optimum, their range of distances in each component, and rules that differ from `RULES`.
NEAR_SHORT, NEAR_LONG = (0.5, (0.0, 0.05), {}), (1.0, (0.15, 0.3), {"success_threshold": 1e-3})


def played(volumes: Mapping[str, LabelVolume], near: tuple, seed: int) -> list[dict]:
    """Return the transitions of one environment."""
    share, distances, rules = near
    env_factory = EnvFactory(observation=SliceChannelsObservation(shape=(84, 84)), **RULES | rules)
    env, rng = env_factory.make_env(volumes), np.random.default_rng(seed)
    obs, _ = env.reset(seed=seed)
    transitions = []
    for _ in range(N_PLAYED // N_ENVS):
        # rz and ty of the four.
        optimum = env.get_wrapper_attr("scene").optimum_normalised[[0, 3]]
        beside = optimum + rng.choice([-1, 1], 2) * rng.uniform(*distances, 2)
        action = np.clip(beside if rng.random() < share else rng.uniform(-1, 1, 2), -1, 1).astype(np.float32)
        obs_next, reward, terminated, truncated, _ = env.step(action)
        names = ("obs", "act", "rew", "terminated", "truncated", "obs_next")
        transitions.append(dict(zip(names, (obs, action, reward, terminated, truncated, obs_next), strict=True)))
        obs = env.reset()[0] if terminated or truncated else obs_next
    return transitions


def batches(volumes: Mapping[str, LabelVolume], near: tuple) -> list[Batch]:
    """Return the transitions of all environments, a batch for each step."""
    return [Batch(list(step)) for step in zip(*(played(volumes, near, i) for i in range(N_ENVS)), strict=True)]


def resident_bytes() -> int:
    """Return this process's memory once freed memory is given back, whose reuse would hide growth."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def array_bytes(batch: Batch) -> int:
    """Return the bytes of all arrays."""
    return sum(array_bytes(part) if isinstance(part, Batch) else part.nbytes for part in batch.values())


def frame_bytes(replay: Replay) -> int:
    """Return the bytes of the compressed frames."""
    return sum(images.frames.n_bytes for images in getattr(replay, "_images", {}).values())


def counted_bytes(replay: Replay) -> int:
    """Return the bytes of all that was added, without what Python and the allocator add to each frame."""
    return array_bytes(replay._meta) + frame_bytes(replay)


def filled(replay: Replay, steps: Iterable[Batch]) -> tuple[float, int]:
    """Add batches; return the seconds it took, and the bytes by which the process has grown."""
    before, start_s = resident_bytes(), time.perf_counter()
    for batch in steps:
        replay.add(batch)
    return time.perf_counter() - start_s, resident_bytes() - before


def sampling_s(replay: Replay, seed: int) -> tuple[float, list[Batch]]:
    """Return the seconds of a sampling, and the observations that it returns."""
    replay.seed(seed)
    start_s = time.perf_counter()
    batch, indices = replay.sample(BATCH_SIZE)
    obs_next = replay[indices].obs_next
    return time.perf_counter() - start_s, [batch.obs, batch.obs_next, obs_next]


def compared(image: Replay, plain: Replay, same: bool) -> tuple[float, float, float]:
    """Return the median milliseconds of a sampling of each, and their median ratio; if `same`, check the samples."""
    rounds = []
    for seed in range(N_ROUNDS):
        (image_s, given), (plain_s, wanted) = sampling_s(image, seed), sampling_s(plain, seed)
        if same:
            for one, other in zip(given, wanted, strict=True):
                for name in one.get_keys():
                    np.testing.assert_array_equal(one[name], other[name])
        rounds.append((image_s * 1e3, plain_s * 1e3, image_s / plain_s))
    return tuple(statistics.median(column) for column in zip(*rounds, strict=True))


def measure(volumes: Mapping[str, LabelVolume], name: str, near: tuple) -> None:
    """Print the table of one kind of episode."""
    steps = batches(volumes, near)
    n_ended = sum(int((step.terminated | step.truncated).sum()) for step in steps)
    space = EnvFactory(observation=SliceChannelsObservation(shape=(84, 84)), **RULES).make_env(volumes)
    plain = Replay(N_PLAIN, N_ENVS)
    image = replay_for(space.observation_space, N_TRANSITIONS, N_ENVS)
    # Compiles: that memory is not the buffer's.
    replay_for(space.observation_space, N_ENVS, N_ENVS).add(steps[0])
    endless, n_steps = cycle(steps), N_PLAIN // N_ENVS
    plain_s, plain_bytes = filled(plain, islice(cycle(steps), n_steps))
    before = resident_bytes()
    first_s, _ = filled(image, islice(endless, n_steps))
    few = compared(image, plain, same=True)
    rest_s, _ = filled(image, islice(endless, N_TRANSITIONS // N_ENVS - n_steps))
    grown, seconds = resident_bytes() - before, first_s + rest_s
    many = compared(image, plain, same=False)
    n_frames = sum(len(images.frames) for images in image._images.values())
    print(f"\n{name}: {N_PLAYED / n_ended:.1f} steps an episode; {n_frames:,} frames of {len(image):,} transitions,")
    print(f"{frame_bytes(image) / n_frames:.0f} bytes each\n")
    print_head("", "compact", "plain", "ratio")
    of_a_million = 1_000_000 / 2**30
    for what, ours, theirs in (
        ("GiB of 1,000,000 transitions, growth of the process", grown / len(image), plain_bytes / N_PLAIN),
        ("GiB of arrays and frames, counted", counted_bytes(image) / len(image), counted_bytes(plain) / N_PLAIN),
    ):
        print_row(what, f"{ours * of_a_million:.2f}", f"{theirs * of_a_million:.2f}", f"1/{theirs / ours:.0f}")
    ours, theirs = seconds / len(image) * 1e6, plain_s / N_PLAIN * 1e6
    print_row("us to add a transition", f"{ours:.0f}", f"{theirs:.0f}", f"{ours / theirs:.2f}")
    for what, figures in ((f"{N_PLAIN:,} in both", few), (f"{len(image):,} and {N_PLAIN:,}", many)):
        print_row(f"ms of a sampling, {what}", *(f"{each:.2f}" for each in figures))


def main() -> None:
    """Print a table for each kind of episode, each measured in its own process."""
    context, volumes = multiprocessing.get_context("spawn"), given_volumes(__doc__)
    for name, near in (("short episodes", NEAR_SHORT), ("long episodes", NEAR_LONG)):
        child = context.Process(target=measure, args=(volumes, name, near))
        child.start()
        child.join()
        if child.exitcode:
            sys.exit(child.exitcode)


if __name__ == "__main__":
    main()
