"""A running episode: its scene, the current plane and its slice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.envs.observations import View
from armscan.envs.rules import ON_REWARD, ON_STOP, Rules
from armscan.envs.scene import Scene
from armscan.errors import InvalidValueError, listed
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_choice
from armscan.volumes.plane import ManipulatorAction


class Episode:
    """One episode.

    Each plane takes two calls, `aim` and `see`, so that the planes of many environments can be looked at together in
    between. The first plane is the start; every further one is a step.

    Args:
        rules: Rules of the environment.
        scene: Scene of the episode.
        optimal_xz: Slice of the scene's optimal plane, indexed [across, depth].
        start: Free components of the first plane, normalised, and `stop` if there is one.
    """

    view: View

    def __init__(self, rules: Rules, scene: Scene, optimal_xz: NDArray[np.uint8], start: FloatArray) -> None:
        self.rules = rules
        self.scene = scene
        self.optimal_xz = optimal_xz
        self.n_steps = -1
        self.is_solved = self.starts_solved = self.is_terminated = self.is_truncated = False
        self.rewards: list[float] = []
        self.aim(start)

    def aim(self, action: FloatArray) -> None:
        """Place the plane; `action` holds the free components, and `stop` if there is one, all within [-1, 1]."""
        normalised = self.scene.optimum_normalised.tolist()
        free = self.rules.free
        for component, value in zip(free, action[: len(free)].tolist(), strict=True):
            normalised[component] = value
        self.action = action
        self._distance: tuple[float, float] | None = None
        self.plane: ManipulatorAction = self.scene.bounds.denormalise(normalised)

    def see(self, view: View) -> None:
        """Set the view of the current plane."""
        view.action = self.action
        self.view = view
        self.n_steps += 1
        self.rewards.append(view.reward)
        self.is_solved = self.rules.is_solved(view)
        if self.n_steps == 0:
            self.starts_solved = self.is_solved
        if self.rules.ends == ON_REWARD:
            self.is_terminated = self.is_solved
        elif self.rules.ends == ON_STOP:
            self.is_terminated = bool(self.action[-1] > 0.0)
        self.is_truncated = not self.is_terminated and self.n_steps >= self.rules.max_steps

    @property
    def distance(self) -> tuple[float, float]:
        """Return the distance of the plane from the optimal one, in mm and degrees."""
        if self._distance is None:
            self._distance = self.scene.distance(self.plane)
        return self._distance

    @property
    def is_running(self) -> bool:
        """Return whether a step can be taken; an episode that starts solved still takes its first."""
        return self.n_steps == 0 or not (self.is_terminated or self.is_truncated)


# Value of each key of `info`, and the type of its array; None if it is a string, a number or a truth value.
INFO: dict[str, tuple[Callable[[Episode], Any], type[np.generic] | None]] = {
    "volume": (lambda episode: episode.scene.volume.name, None),
    "rotation_deg": (lambda episode: episode.plane.rotation, np.float64),
    "translation_mm": (lambda episode: episode.plane.translation, np.float64),
    "counts": (lambda episode: episode.view.landmarks[:, 0], np.int64),
    "is_success": (lambda episode: episode.is_solved, None),
    "starts_solved": (lambda episode: episode.starts_solved, None),
    "action": (lambda episode: episode.action, np.float32),
    "reward": (lambda episode: episode.view.reward, None),
    "distance_mm": (lambda episode: episode.distance[0], None),
    "distance_deg": (lambda episode: episode.distance[1], None),
}


def info_of(episode: Episode) -> dict[str, Any]:
    """Return `info`, as `ArmscanEnv` describes it."""
    return {
        name: of(episode) if dtype is None else np.array(of(episode), dtype=dtype) for name, (of, dtype) in INFO.items()
    }


def begin(rules: Rules, rngs: Sequence[np.random.Generator], volume_names: Sequence[str | None]) -> list[Episode]:
    """Begin an episode for each generator, the source of all its random numbers.

    Their first planes are still to be looked at.

    Args:
        rules: Rules of the episodes.
        rngs: NumPy generator of each episode.
        volume_names: Name of each episode's volume; None draws one.
    """
    drawn = [
        rules.names[int(rng.integers(len(rules.names)))] if name is None else name
        for name, rng in zip(volume_names, rngs, strict=True)
    ]
    scenes = rules.draw_scenes(drawn, rngs)
    return [Episode(rules, *scene, _start(rules, rng)) for scene, rng in zip(scenes, rngs, strict=True)]


def _start(rules: Rules, rng: np.random.Generator) -> FloatArray:
    start = np.zeros(len(rules.action_names))
    if rules.start == "random":
        start[: len(rules.free)] = rng.uniform(-1.0, 1.0, len(rules.free))
    return start


def look(rules: Rules, episodes: Sequence[Episode]) -> None:
    """Look at the current plane of each episode."""
    views = rules.look([episode.scene for episode in episodes], [episode.plane for episode in episodes])
    for episode, view in zip(episodes, views, strict=True):
        episode.see(view)


def check_actions(actions: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return an action, or a batch, of this shape as finite numbers within [-1, 1]; values outside are clipped."""
    try:
        # A copy, so that later changes to the caller's array have no effect. `same_kind` refuses strings.
        received = np.asarray(actions).astype(np.float64, casting="same_kind")
        # In plain Python, which is faster than NumPy for a few numbers.
        if received.shape == shape and all(-1.0 <= number <= 1.0 for number in received.ravel().tolist()):
            return received
    except (TypeError, ValueError):
        received = np.empty(0)
    if received.shape != shape or not np.isfinite(received).all():
        raise InvalidValueError(f"action is {actions!r}, but it must be an array of shape {shape} of finite numbers")
    return np.minimum(np.maximum(received, -1.0), 1.0)


def wanted_volume(rules: Rules, options: Any) -> str | None:
    """Return the volume that the options of a reset name, None if they name none; refuse all other options."""
    if options is None:
        return None
    if not isinstance(options, dict):
        raise InvalidValueError(f"reset options are {options!r}, but they must be a dict such as {{'volume': name}}")
    if unknown := sorted(map(str, options.keys() - {"volume"})):
        raise InvalidValueError(f"reset option is {listed(unknown)}, but only 'volume' is known")
    return check_choice("reset option 'volume'", options["volume"], rules.names) if "volume" in options else None
