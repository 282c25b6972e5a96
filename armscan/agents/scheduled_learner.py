"""A learner whose hyperparameters change at given environment steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from armscan.agents.batch_agent import batch_agent
from armscan.agents.protocols import Learner
from armscan.envs.actions import ActionBounds
from armscan.envs.rules import Observed
from armscan.utils.arrays import FloatArray

if TYPE_CHECKING:
    from armscan.agents.policy import Policy

# Optional attributes of a learner that evaluations and runs read.
OPTIONAL = ("validation_note", "warm_up_note", "weights_note", "expected_error", "expected_errors")


class ScheduledLearner:
    """A sequence of learners, each of which replaces the one before it at a given environment step.

    At the first epoch that begins at or after that step, the next learner loads the state of the one before. Which one
    learns depends on the environment steps alone, so a training that is resumed at any epoch, or continued from
    another's checkpoint, equals bit for bit one that was never interrupted.

    Args:
        first: Learner of the beginning.
        later: First environment step and learner of each segment, in order; each has learned nothing yet.
    """

    def __init__(self, first: Learner, later: Sequence[tuple[int, Learner]]) -> None:
        self._use(first)
        self._later = list(later)
        self._has_learned = False

    def _use(self, learner: Learner) -> None:
        self._learner, self._batch = learner, batch_agent(learner)

    @property
    def n_env_steps(self) -> int:
        """See `Learner.n_env_steps`."""
        return self._learner.n_env_steps

    @property
    def env_steps_at_once(self) -> int:
        """See `Learner.env_steps_at_once`."""
        return self._learner.env_steps_at_once

    @property
    def update_note(self) -> str | None:
        """See `Learner.update_note`."""
        return self._learner.update_note

    @property
    def schedule_note(self) -> str | None:
        """Return which changes no epoch has applied yet, for the log; None if there are none, or it has not learned."""
        unused = " or ".join(str(start) for start, _ in self._later if self._has_learned)
        return f"no epoch began at or after {unused} environment steps: no such change was made" if unused else None

    def __getattr__(self, name: str) -> Any:
        """Return an optional attribute of the current learner."""
        if name in OPTIONAL:
            return getattr(self._learner, name)
        raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")

    def warm_up(self) -> None:
        """See `Learner.warm_up`."""
        self._learner.warm_up()

    def learn(self, n_env_steps: int) -> dict[str, float]:
        """Learn with the hyperparameters of the current segment; see `Learner.learn`."""
        due = None
        while self._later and self._later[0][0] <= self.n_env_steps:
            due = self._later.pop(0)[1]
        if due is not None:
            due.load_state(self._learner.state())
            self._use(due)
        self._has_learned = True
        return self._learner.learn(n_env_steps)

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """See `Agent.begin`."""
        self._learner.begin(seed=seed, bounds=bounds)

    def act(self, observation: Observed, reward: float) -> NDArray[Any]:
        """See `Agent.act`."""
        return self._learner.act(observation, reward)

    def begin_all(self, *, seeds: Sequence[int], bounds: Sequence[ActionBounds]) -> None:
        """See `BatchAgent.begin_all`."""
        self._batch.begin_all(seeds=seeds, bounds=bounds)

    def act_all(self, observations: Observed, rewards: FloatArray, episodes: NDArray[Any]) -> NDArray[Any]:
        """See `BatchAgent.act_all`."""
        return self._batch.act_all(observations, rewards, episodes)

    def policy(self) -> Policy:
        """See `Learner.policy`."""
        return self._learner.policy()

    def weights(self) -> dict[str, Any]:
        """See `Learner.weights`."""
        return self._learner.weights()

    def load_weights(self, weights: dict[str, Any]) -> None:
        """See `Learner.load_weights`."""
        self._learner.load_weights(weights)

    def state(self) -> dict[str, Any]:
        """See `Learner.state`."""
        return self._learner.state()

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned, or the state of a learner without a schedule; see `Learner.load_state`."""
        self._learner.load_state(state)
