"""A search by Optuna: every episode is a study of its own, every plane a trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from armscan.agents.protocols import AgentSetup
from armscan.envs.actions import STOP, ActionBounds
from armscan.envs.rules import Observed
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_choice, check_int

if TYPE_CHECKING:
    from optuna.samplers import BaseSampler

SAMPLERS = ("tpe", "cmaes", "gp")


@dataclass(frozen=True, kw_only=True)
class OptunaSearch:
    """Search for the plane with an Optuna sampler, which sees only the rewards of the planes it has proposed.

    Each episode is a new study in memory. The reward of the start is not passed on, because no agent is told which
    plane the start is. The named sampler proposes every plane, even with one free component, for which CMA-ES in
    earlier versions of Optuna fell back to random planes. If success does not end an episode (`env.ends`), step
    `env.max_steps` returns to the best plane.

    Raises:
        InvalidValueError: If a value is impossible.
    """

    sampler: str = "tpe"
    """Sampler of Optuna: `tpe`, `cmaes`, or `gp`, which takes about 50 ms per plane; the others take 1 ms."""

    n_startup_trials: int | None = None
    """Number of random planes before the sampler's model is used, 1 or more. None: the sampler's own number, 10 for TPE
    and GP, 1 for CMA-ES.
    """

    def __post_init__(self) -> None:
        check_choice("agent.sampler", self.sampler, SAMPLERS)
        if self.n_startup_trials is not None:
            check_int("agent.n_startup_trials", self.n_startup_trials, at_least=1)

    def agent(self, setup: AgentSetup) -> OptunaAgent:
        """Make an agent."""
        # Deferred, here and below: only a search with Optuna needs this slow import.
        import optuna

        # Optuna logs a line for every study, so for every episode, and warns that the GP sampler has no accelerator.
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        return OptunaAgent(setup.action_names, self, setup.n_steps)


class OptunaAgent:
    """Agent that asks a study for planes and tells it their rewards.

    Args:
        names: Names of an action's components.
        search: Sampler of the study.
        n_steps: Number of steps of an episode, the last of which takes the best plane; see `AgentSetup`.
    """

    def __init__(self, names: Sequence[str], search: OptunaSearch, n_steps: int | None) -> None:
        self._names, self._search, self._n_steps = tuple(names), search, n_steps

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """Begin a study, with a sampler seeded with `seed`."""
        import optuna

        self._study = optuna.create_study(direction="maximize", sampler=_sampler(self._search, seed))
        self._trial: optuna.Trial | None = None

    def act(self, observation: Observed, reward: float) -> FloatArray:
        """Report the reward of the last plane; return the next one, shape (n_action,)."""
        if self._trial is not None:
            self._study.tell(self._trial, reward)
            if self._trial.number + 2 == self._n_steps:
                return self._action(self._study.best_params)
        self._trial = trial = self._study.ask()
        return self._action({name: trial.suggest_float(name, -1.0, 1.0) for name in self._names if name != STOP})

    def _action(self, plane: Mapping[str, float]) -> FloatArray:
        return np.array([plane.get(name, -1.0) for name in self._names])


def _sampler(search: OptunaSearch, seed: int) -> BaseSampler:
    from optuna.samplers import CmaEsSampler, GPSampler, TPESampler

    # Without a number, each sampler uses its own default.
    startup: dict[str, Any] = {} if search.n_startup_trials is None else {"n_startup_trials": search.n_startup_trials}
    if search.sampler == "cmaes":
        return CmaEsSampler(seed=seed, warn_independent_sampling=False, **startup)
    return (GPSampler if search.sampler == "gp" else TPESampler)(seed=seed, **startup)
