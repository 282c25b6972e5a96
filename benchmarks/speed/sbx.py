"""Measure the processor time of a training with SBX's SAC, which is compiled by JAX, in the default environment.

    python -m benchmarks.speed.sbx [--threads N]

SBX is not among armscan's dependencies: `pip install . sbx-rl` into its own virtual environment. Environments, networks
(64-64), batches of 256, replay buffer, random steps at the start and updates (4 after each 16 steps) are as in the
default run, with 20,000 steps; nothing is validated. `benchmarks.speed.training` measures ours, validations included.
The first training of the process compiles, those after it are measured.
"""

from __future__ import annotations

import os
import statistics
import time
from typing import Any

import numpy as np

from benchmarks.arguments import count, parser_of

N_STEPS, N_ENVS, LEARNING_STARTS, N_UPDATES = 20_000, 16, 2_000, 4
N_TRAININGS = 2


def environments() -> Any:
    """Return the environments as a `VecEnv` of Stable-Baselines3, which resets those whose episode has ended."""
    from gymnasium.vector import AutoresetMode
    from stable_baselines3.common.vec_env import VecEnv

    from armscan.envs import ArmscanVectorEnv
    from armscan.volumes import load_phantoms

    class SideBySide(VecEnv):
        def __init__(self) -> None:
            self.envs = ArmscanVectorEnv(N_ENVS, load_phantoms(range(16)), autoreset_mode=AutoresetMode.DISABLED)
            # As in our trainings.
            self.envs.info_keys = ("action", "reward", "is_success")
            super().__init__(N_ENVS, self.envs.single_observation_space, self.envs.single_action_space)

        def reset(self) -> Any:
            return self.envs.reset(seed=0)[0]

        def step_async(self, actions: Any) -> None:
            self.actions = actions

        def step_wait(self) -> Any:
            observations, rewards, terminated, truncated, _ = self.envs.step(self.actions)
            done = terminated | truncated
            infos: list[dict[str, Any]] = [{} for _ in range(N_ENVS)]
            if done.any():
                for i in np.flatnonzero(done):
                    infos[i] = {"terminal_observation": observations[i], "TimeLimit.truncated": bool(truncated[i])}
                observations, _ = self.envs.reset(options={"reset_mask": done})
            return observations, rewards.astype(np.float32), done, infos

        def close(self) -> None:
            self.envs.close()

        def get_attr(self, attr_name: str, indices: Any = None) -> Any:
            return [getattr(self.envs, attr_name, None)] * N_ENVS

        # Abstract in Stable-Baselines3; its trainings call neither of the two.
        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise NotImplementedError

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
            raise NotImplementedError

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> Any:
            return [False] * N_ENVS

    return SideBySide()


def train(envs: Any, seed: int) -> float:
    """Return the seconds of processor time of a training."""
    from sbx import SAC

    model = SAC(
        "MlpPolicy",
        envs,
        learning_rate=1e-3,
        buffer_size=100_000,
        learning_starts=LEARNING_STARTS,
        batch_size=256,
        train_freq=1,
        gradient_steps=N_UPDATES,
        gamma=0.9,
        ent_coef="auto_0.1",
        target_entropy=-2.0,
        policy_kwargs={"net_arch": [64, 64]},
        seed=seed,
    )
    start_s = time.process_time()
    model.learn(N_STEPS)
    return time.process_time() - start_s


def main() -> None:
    """Print the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--threads", type=count, default=1, help="processor cores to use (default: 1)")
    given = parser.parse_args()
    # Before JAX and Numba count the cores.
    os.environ |= {name: str(given.threads) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: given.threads])
    envs = environments()
    first, *others = (train(envs, seed) for seed in range(1 + N_TRAININGS))
    print(f"the first training, which compiles: {first:.1f} s")
    print(
        f"{N_TRAININGS} more: {', '.join(f'{each:.1f}' for each in others)}, median {statistics.median(others):.1f} s"
    )


if __name__ == "__main__":
    main()
