"""The Gymnasium environment: find the carpal tunnel's plane in a labelmap of an arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from armscan.anatomy import PUBLISHED_TARGETS, TissueClusters, checked_targets, landmark_reward
from armscan.checks import check_choice, check_float, check_int, check_numbers
from armscan.envs.actions import free_components
from armscan.envs.observations import FloatVector, Observation, View, flat_space, flattened, with_action_reward
from armscan.envs.scene import RandomTransform, Scene, SceneSampler, slice_geometry
from armscan.errors import InvalidValueError, ResetNeededError, listed
from armscan.volumes import LabelVolume, load_phantoms, read_dataset
from armscan.volumes.plane import FloatArray, ManipulatorAction

STARTS = ("middle", "random")
DEFAULT_PHANTOMS = range(4)

Volumes = Mapping[str, LabelVolume] | Sequence[LabelVolume] | str | Path | None


class ArmscanEnv(gym.Env[FloatVector, FloatArray]):
    """Moves a slicing plane through a labelmap of an arm until the slice shows the carpal tunnel.

    ## Description
    An episode is played on one volume, drawn at random and moved by a random rigid motion. Each action places the plane
    anew (absolute, not relative to where it was); the slice under it is looked up and its landmarks are clustered.

    ## Action space
    `Box(-1, 1, (n_free,))`: the free components of (rz, rx, tx, ty), normalised. Rotations are a * bound degrees,
    translations (a + 1) / 2 * bound mm. The components that the projection does not leave free stay at the optimal
    plane's. Values outside [-1, 1] are clipped; a NaN or infinity, or another shape, raises `InvalidValueError`.

    ## Observation space
    A flat `Box` of 32-bit floats: the parts of the chosen observation, the last action (n_free), the reward (1).

    | observation | parts before action and reward |
    | --- | --- |
    | `action_reward` | none |
    | `cluster` | for bones, tendons, artery each: clusters, clustered pixels, mean centre (across, depth): 12 numbers |

    ## Rewards
    `landmark_reward` of the slice, in [-1, 0]: 0 where every count is on target, no tissue is missing, and the tendons
    lie between bones and artery.

    ## Starting state
    The fixed components at the optimum; the free ones at normalised 0 (`start="middle"`) or drawn (`start="random"`).
    `reset(options={"volume": name})` chooses the volume. An episode may start on a plane that already scores above
    -delta: it still takes its first step, and `info["starts_solved"]` says so.

    ## Episode end
    Terminated when the reward is above -delta; truncated after `max_steps` steps.

    ## Info
    `volume` (name), `rotation_deg` (rz, rx), `translation_mm` (tx, ty), `counts` (clusters of bones, tendons, artery),
    `is_success`, `starts_solved`, `action` (free components, normalised), `reward`, and the distance to the optimal
    plane: `distance_mm` (of the slice's centre, along the optimal normal) and `distance_deg` (between the normals).

    Args:
        volumes: volumes by name or in a sequence, or the folder of a dataset; four phantoms where it is None.
        observation: what the agent sees, by name or as an object.
        projection: which components are free: `x`, `y`, `xy`, `zy`, `full`, or a list of `rz`, `rx`, `tx`, `ty`.
        targets: clusters of bones, tendons and artery that the wanted plane shows.
        delta: the episode ends above -delta.
        max_steps: steps after which an episode is truncated.
        start: `middle` or `random`.
        rotation_bounds_deg: bounds of rz and rx.
        translation_bounds_mm: bounds of tx and ty; the current volume's size where it is None.
        transform: the motions of the volume at reset; None leaves it as it is.
        render_mode: `rgb_array` or None.

    Raises:
        InvalidValueError: if an argument is outside what is allowed.
        OptimalPlaneError: if a volume's labelled plane is missing, outside the bounds, or scores no better than -delta.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as Gymnasium declares it
        "render_modes": ["rgb_array"],
        "render_fps": 4,
    }

    def __init__(
        self,
        volumes: Volumes = None,
        *,
        observation: str | Observation = "cluster",
        projection: str | Sequence[str] = "y",
        targets: Sequence[int] = PUBLISHED_TARGETS,
        delta: float = 0.05,
        max_steps: int = 50,
        start: str = "middle",
        rotation_bounds_deg: tuple[float, float] = (180.0, 180.0),
        translation_bounds_mm: tuple[float, float] | None = None,
        transform: RandomTransform | None = RandomTransform(),  # noqa: B008 - it is immutable
        render_mode: str | None = None,
    ) -> None:
        self.volumes = named_volumes(volumes)
        self.targets = checked_targets(targets)
        self.delta = check_float("delta", delta, above=0.0, at_most=1.0)
        self.max_steps = check_int("max_steps", max_steps, at_least=1)
        self.start = check_choice("start", start, STARTS)
        self.render_mode = check_choice("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        rotation = check_numbers("rotation_bounds_deg", rotation_bounds_deg, 2, "for rz and rx")
        if translation_bounds_mm is not None:
            translation = check_numbers("translation_bounds_mm", translation_bounds_mm, 2, "for tx and ty")
            translation_bounds_mm = (translation[0], translation[1])
        self._sampler = SceneSampler(
            rotation_bounds_deg=(rotation[0], rotation[1]),
            translation_bounds_mm=translation_bounds_mm,
            transform=transform,
            delta=self.delta,
            targets=self.targets,
        )
        for volume in self.volumes.values():
            self._sampler.check(volume)
        self._names = list(self.volumes)
        self._free = list(free_components(projection))
        self._observation = with_action_reward(observation)
        parts = self._observation.spaces([slice_geometry(v) for v in self.volumes.values()], len(self._free))
        self.observation_space: spaces.Box = flat_space(parts)  # type: ignore[assignment]
        self.action_space: spaces.Box = spaces.Box(  # type: ignore[assignment]
            -1.0, 1.0, (len(self._free),), np.float32
        )
        self._scene: Scene | None = None
        self._running = False

    @property
    def scene(self) -> Scene:
        """The volume of the current episode and where its optimal plane lies.

        Raises:
            ResetNeededError: before the first reset.
        """
        if self._scene is None:
            raise ResetNeededError("the environment has no episode yet: call reset() first")
        return self._scene

    @property
    def plane(self) -> ManipulatorAction:
        """The current plane, in the moved volume's frame."""
        _ = self.scene
        return self._plane

    @property
    def slice_xz(self) -> NDArray[np.uint8]:
        """The current slice, indexed [across, depth]."""
        _ = self.scene
        return self._view.slice_xz

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatVector, dict[str, Any]]:
        """Starts an episode; `options={"volume": name}` chooses its volume."""
        super().reset(seed=seed)
        self._scene = self._sampler.draw(self._drawn_volume(options or {}), self.np_random)
        n_free = len(self._free)
        action = np.zeros(n_free) if self.start == "middle" else self.np_random.uniform(-1.0, 1.0, n_free)
        self._n_steps = 0
        self._running = True
        self._starts_solved = False
        self._place(action)
        self._starts_solved = self._view.reward > -self.delta
        return self._observed(), self._info()

    def step(self, action: FloatArray) -> tuple[FloatVector, float, bool, bool, dict[str, Any]]:
        """Places the plane; see the class for what comes back."""
        if not self._running:
            raise ResetNeededError("the episode has ended or not begun: call reset() before step()")
        try:
            received = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            received = np.empty(0)
        if received.shape != self.action_space.shape or not np.isfinite(received).all():
            raise InvalidValueError(
                f"action is {action!r}, but it must be an array of shape {self.action_space.shape} of finite numbers"
            )
        self._place(np.clip(received, -1.0, 1.0))
        self._n_steps += 1
        terminated = self._view.reward > -self.delta
        truncated = not terminated and self._n_steps >= self.max_steps
        self._running = not (terminated or truncated)
        return self._observed(), self._view.reward, terminated, truncated, self._info()

    def render(self) -> NDArray[np.uint8] | None:
        """Returns a picture of the current step, shape (height, width, 3), None without a render mode."""
        if self.render_mode is None:
            gym.logger.warn("render() was called without a render_mode; make the environment with 'rgb_array'.")
            return None
        # Deferred: drawing is not needed to step.
        from armscan.envs.rendering import draw_frame

        return draw_frame(self.scene, self._plane, self._view, self._n_steps)

    def _drawn_volume(self, options: dict[str, Any]) -> LabelVolume:
        if not isinstance(options, dict):
            raise InvalidValueError(
                f"reset options are {options!r}, but they must be a dict such as {{'volume': name}}"
            )
        if unknown := sorted(map(str, options.keys() - {"volume"})):
            raise InvalidValueError(f"reset option is {listed(unknown)}, but only 'volume' is known")
        if "volume" in options:
            return self.volumes[check_choice("reset option 'volume'", options["volume"], self._names)]
        return self.volumes[self._names[int(self.np_random.integers(len(self._names)))]]

    def _place(self, action: FloatArray) -> None:
        """Moves the plane; the slice, its clusters and the reward are computed here, once a step."""
        normalised = self.scene.optimum_normalised.copy()
        normalised[self._free] = action
        volume = self.scene.volume
        self._plane = self.scene.bounds.denormalised(normalised)
        slice_xz = volume.slice(self._plane, transform=self.scene.transform)
        clusters = TissueClusters.from_slice(slice_xz)
        reward = landmark_reward(clusters, self.targets)
        self._view = View(slice_xz, clusters, slice_geometry(volume), action, reward)

    def _observed(self) -> FloatVector:
        return flattened(self._observation.observe(self._view))

    def _info(self) -> dict[str, Any]:
        distance_mm, distance_deg = self.scene.distance(self._plane)
        return {
            "volume": self.scene.volume.name,
            "rotation_deg": np.array(self._plane.rotation),
            "translation_mm": np.array(self._plane.translation),
            "counts": np.array(self._view.clusters.counts),
            "is_success": self._view.reward > -self.delta,
            "starts_solved": self._starts_solved,
            "action": self._view.action.astype(np.float32),
            "reward": self._view.reward,
            "distance_mm": distance_mm,
            "distance_deg": distance_deg,
        }


def named_volumes(volumes: Volumes) -> dict[str, LabelVolume]:
    """Returns volumes given in any of the ways that `ArmscanEnv` takes, by name.

    Raises:
        InvalidValueError: if there is none, something else is among them, or two have the same name.
    """
    if volumes is None:
        return load_phantoms(DEFAULT_PHANTOMS)
    if isinstance(volumes, str | Path):
        return read_dataset(volumes)
    if isinstance(volumes, Mapping):
        listed_volumes = list(volumes.values())
    elif isinstance(volumes, list | tuple):
        listed_volumes = list(volumes)
    else:
        raise InvalidValueError(f"volumes is {volumes!r}, but it must be volumes by name or in a list, or a folder")
    if not listed_volumes:
        raise InvalidValueError("volumes is empty, but an environment needs at least one")
    for volume in listed_volumes:
        if not isinstance(volume, LabelVolume):
            raise InvalidValueError(f"volumes holds {volume!r}, but each must be a LabelVolume")
    named = {volume.name: volume for volume in listed_volumes}
    if len(named) < len(listed_volumes):
        raise InvalidValueError(f"volumes holds two of the same name among {listed(v.name for v in listed_volumes)}")
    return named
