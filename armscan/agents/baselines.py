"""Non-learning baselines: random planes, and all planes in fixed steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.agents.protocols import AgentSetup
from armscan.envs.actions import COMPONENTS, ActionBounds
from armscan.envs.rules import Observed
from armscan.errors import InvalidValueError, listed
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_float

ROTATIONS = ("rz", "rx")
MAX_SWEPT = 2
MAX_PLANES = 1_000_000


@dataclass(frozen=True)
class Random:
    """Planes drawn uniformly over the free components."""

    def agent(self, setup: AgentSetup) -> RandomAgent:
        """Make an agent."""
        return RandomAgent(len(setup.action_names))


class RandomAgent:
    """Draws planes with `n_action` components."""

    def __init__(self, n_action: int) -> None:
        self._n_action = n_action

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """Begin an episode; its planes are drawn from the seed."""
        # A child: the environment is often reset with the seed itself, and draws its volume's motion from that.
        (child,) = np.random.SeedSequence(seed).spawn(1)
        self._rng = np.random.default_rng(child)

    def act(self, observation: Observed, reward: float) -> FloatArray:
        """Return the next action, shape (n_action,)."""
        return self._rng.uniform(-1.0, 1.0, self._n_action)


@dataclass(frozen=True, kw_only=True)
class Exhaustive:
    """All planes in fixed steps, from the middle of the swept components' ranges outward.

    The middle is a rotation of 0 and half the bound of a translation. Each plane is visited once, in order of its
    distance from the middle, counted in steps; ties go to the smaller component. The sweep ends at the last whole step
    within the range. If all planes were visited and none ended the episode, the agent stays at the one with the best
    reward. If success does not end an episode (`env.ends`), step `env.max_steps` returns to that plane, too.

    Components that are free but not swept are held at 0 degrees or 0 mm: the plane straight across the arm with the
    whole hand in the picture. (The middle of tx, normalised 0, would push half of the hand out of it.) The agent never
    stops an episode by itself.

    Raises:
        InvalidValueError: If a value is impossible.
    """

    swept: Sequence[str] | None = ("ty",)
    """Components to sweep, one or two. None: all free ones, of which there must be at most two: more would take
    thousands of planes even in wide steps.
    """

    step_mm: float = 5.0
    """Distance between planes along swept translations, in mm, from 0.01 to 1e6."""

    step_deg: float = 10.0
    """Angle between planes about swept rotations, in degrees, from 0.01 to 360."""

    def __post_init__(self) -> None:
        check_float("agent.step_mm", self.step_mm, at_least=0.01, at_most=1e6)
        check_float("agent.step_deg", self.step_deg, at_least=0.01, at_most=360.0)
        if self.swept is None:
            return
        is_list = isinstance(self.swept, list | tuple) and all(isinstance(name, str) for name in self.swept)
        names = list(self.swept) if is_list else []
        if not 1 <= len(names) <= MAX_SWEPT or len(set(names)) < len(names) or not set(names) <= set(COMPONENTS):
            raise InvalidValueError(
                f"agent.swept is {self.swept!r}, but it must be a list of one or two different ones of "
                f"{listed(COMPONENTS)}, or null for all free components"
            )

    def agent(self, setup: AgentSetup) -> ExhaustiveAgent:
        """Make an agent.

        Raises:
            InvalidValueError: If a component to be swept is not free, or more than two are.
        """
        free = setup.action_names
        swept = tuple(name for name in COMPONENTS if name in (free if self.swept is None else self.swept))
        if fixed := [name for name in swept if name not in free]:
            raise InvalidValueError(
                f"agent.swept is {list(swept)}, but {listed(fixed)} is not free; projection leaves only "
                f"{', '.join(free)} free"
            )
        if len(swept) > MAX_SWEPT:
            raise InvalidValueError(
                f"agent.swept is null, for all free components: {', '.join(free)}; but it must be one or two, because "
                "a grid over more takes thousands of planes: name them, as in agent.swept=[rz,ty]"
            )
        return ExhaustiveAgent(free, swept, step_mm=self.step_mm, step_deg=self.step_deg, n_steps=setup.n_steps)


class ExhaustiveAgent:
    """Goes through planes in the order of `Exhaustive`, with actions of the `free` components.

    Args:
        free: Names of an action's components.
        swept: Names of the components to sweep.
        step_mm: Distance between planes along swept translations, in mm.
        step_deg: Angle between planes about swept rotations, in degrees.
        n_steps: Number of steps of an episode; see `AgentSetup`.
    """

    def __init__(
        self, free: Sequence[str], swept: Sequence[str], *, step_mm: float, step_deg: float, n_steps: int | None
    ) -> None:
        self._free, self._swept = tuple(free), tuple(swept)
        self._step_mm, self._step_deg, self._n_steps = step_mm, step_deg, n_steps

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """Begin an episode with the middle plane."""
        self._planes = self.planes(bounds)
        self._rewards: list[float] = []
        self._n_looked_at = 0

    def act(self, observation: Observed, reward: float) -> FloatArray:
        """Return the next plane, or the best one when all were visited, shape (n_action,)."""
        # The first reward belongs to the start, which is none of these planes.
        if 0 < self._n_looked_at <= len(self._planes):
            self._rewards.append(reward)
        self._n_looked_at += 1
        is_answer = self._n_looked_at > len(self._planes) or self._n_looked_at == self._n_steps
        chosen = int(np.argmax(self._rewards)) if is_answer and self._rewards else self._n_looked_at - 1
        return np.array(self._planes[chosen])

    def planes(self, bounds: ActionBounds) -> FloatArray:
        """Return all planes in their order, normalised, shape (n_planes, n_action).

        Raises:
            InvalidValueError: If the steps are so small that there are more than a million.
        """
        # Half a component's range, counted in steps. The normalised middle is 0 for rotations and translations alike.
        halves = [self._half_range_steps(name, bounds) for name in self._swept]
        # Rounding must not exclude a step that ends exactly at the end of the range.
        n_each_side = [math.floor(half + 1e-9) for half in halves]
        if (n_planes := math.prod(2 * n + 1 for n in n_each_side)) > MAX_PLANES:
            raise InvalidValueError(
                f"agent.step_mm is {self._step_mm:g} and agent.step_deg is {self._step_deg:g}, which give {n_planes} "
                f"planes of {' and '.join(self._swept)}, but there must be at most {MAX_PLANES}"
            )
        counts = np.meshgrid(*(np.arange(-n, n + 1) for n in n_each_side), indexing="ij")
        steps = np.stack(counts, axis=-1).reshape(-1, len(self._swept))
        steps = steps[np.argsort((steps**2).sum(axis=1), kind="stable")]
        planes = np.tile([0.0 if name in ROTATIONS else -1.0 for name in self._free], (len(steps), 1))
        for name, half, column in zip(self._swept, halves, steps.T, strict=True):
            planes[:, self._free.index(name)] = np.clip(column / half, -1.0, 1.0) if half else 0.0
        return planes

    def _half_range_steps(self, name: str, bounds: ActionBounds) -> float:
        bound = (bounds.rotation_deg + bounds.translation_mm)[COMPONENTS.index(name)]
        return bound / self._step_deg if name in ROTATIONS else bound / 2.0 / self._step_mm
