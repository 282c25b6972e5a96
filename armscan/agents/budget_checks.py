"""Check that the budget of a training leaves room for its collections, updates and batches."""

from __future__ import annotations

from armscan.agents.protocols import AgentSetup
from armscan.errors import InvalidValueError


def round_up(n_env_steps: int, num_envs: int) -> int:
    """Return the next multiple of the number of environments, which are only stepped all at once."""
    return -(-n_env_steps // num_envs) * num_envs


def buffer_capacity(buffer_size: int, num_envs: int, setup: AgentSetup) -> int:
    """Return how many transitions a buffer needs to hold: what it may, but no more than the whole training takes."""
    return min(buffer_size, setup.total_env_steps + num_envs)


def check_collection(n_asked: int, num_envs: int, setup: AgentSetup, *, learning_starts: int = 0) -> int:
    """Return the environment steps of one collection, if the training has as many.

    Args:
        n_asked: environment steps that are asked for.
        num_envs: environments, which all take as many.
        setup: training environments, observation space, action names, budget in environment steps, seed and compute.
        learning_starts: taken before the first collection.

    Raises:
        InvalidValueError: if it has not.
    """
    n_collected, n_left = round_up(n_asked, num_envs), setup.total_env_steps - learning_starts
    if n_collected > n_left:
        after = f" - {learning_starts} random ones" if learning_starts else ""
        raise InvalidValueError(
            f"agent.env_steps_per_collection is {n_asked}, {n_collected} for {num_envs} environments, but it must "
            f"be at most {n_left} = training.env_steps{after}"
        )
    return n_collected


def check_updates(utd_ratio: float, setup: AgentSetup, *, learning_starts: int = 0) -> None:
    """Raise `InvalidValueError` where a whole training would come to no gradient step."""
    n_left = setup.total_env_steps - learning_starts
    if utd_ratio * n_left < 1:
        raise InvalidValueError(
            f"agent.utd_ratio is {utd_ratio:g}, but it must be at least {1 / n_left:.3g}, or not "
            f"one gradient step is taken in {n_left} environment steps"
        )


def check_batch(batch_size: int, n_kept: int, what: str) -> None:
    """Raise `InvalidValueError` where a batch is larger than what it is drawn from, which `what` names."""
    if batch_size > n_kept:
        raise InvalidValueError(f"agent.batch_size is {batch_size}, but it must be at most {n_kept}, {what}")
