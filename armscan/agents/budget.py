"""What the budget of a training has to leave room for."""

from __future__ import annotations

from armscan.agents.protocols import AgentSetup
from armscan.errors import InvalidValueError


def rounded_up(n_env_steps: int, num_envs: int) -> int:
    """Returns the next multiple of the number of environments, which are only stepped all at once."""
    return -(-n_env_steps // num_envs) * num_envs


def kept_at_most(buffer_size: int, num_envs: int, setup: AgentSetup) -> int:
    """Returns how many transitions a buffer needs to hold: what it may, but no more than the whole training takes."""
    return min(buffer_size, setup.total_env_steps + num_envs)


def check_collection(n_asked: int, num_envs: int, setup: AgentSetup, *, random_env_steps: int = 0) -> int:
    """Returns the environment steps of one collection, if the training has as many.

    Args:
        n_asked: environment steps that are asked for.
        num_envs: environments, which all take as many.
        setup: what the agent is given.
        random_env_steps: taken before the first collection.

    Raises:
        InvalidValueError: if it has not.
    """
    n_collected, n_left = rounded_up(n_asked, num_envs), setup.total_env_steps - random_env_steps
    if n_collected > n_left:
        after = f" - {random_env_steps} random ones" if random_env_steps else ""
        raise InvalidValueError(
            f"agent.env_steps_per_collection is {n_asked}, {n_collected} for {num_envs} environments, but it must "
            f"be at most {n_left} = training.env_steps{after}"
        )
    return n_collected


def check_updates(updates_per_env_step: float, setup: AgentSetup, *, random_env_steps: int = 0) -> None:
    """Raises `InvalidValueError` where a whole training would come to no gradient step."""
    n_left = setup.total_env_steps - random_env_steps
    if updates_per_env_step * n_left < 1:
        raise InvalidValueError(
            f"agent.updates_per_env_step is {updates_per_env_step:g}, but it must be at least {1 / n_left:.3g}, or not "
            f"one gradient step is taken in {n_left} environment steps"
        )


def check_batch(batch_size: int, n_kept: int, what: str) -> None:
    """Raises `InvalidValueError` where a batch is larger than what it is drawn from, which `what` names."""
    if batch_size > n_kept:
        raise InvalidValueError(f"agent.batch_size is {batch_size}, but it must be at most {n_kept}, {what}")
