"""Rules of an environment: volumes, actions, observations, reward, end of an episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from armscan.anatomy import (
    PUBLISHED_TARGETS,
    SUCCESS_THRESHOLD,
    Landmarks,
    Reward,
    Scanner,
    Tissues,
    check_tissues,
    fitted_reward,
)
from armscan.envs.actions import COMPONENTS, STOP, ActionBounds, free_components
from armscan.envs.observation_registry import ObservationLike, with_action_reward
from armscan.envs.observations import SliceGeometry, View, observe_all, smallest_shape
from armscan.envs.scene import RandomTransform, Scene, SceneSampler, shows_labelled
from armscan.envs.spaces import MultiBoxSpace, Parts, flat_space, flatten, in_order
from armscan.errors import InvalidValueError, OptimalPlaneError, listed
from armscan.utils.validation import check_bool, check_choice, check_float, check_int, check_numbers
from armscan.volumes import LabelVolume, load_phantoms, read_dataset
from armscan.volumes.plane import ManipulatorAction

STARTS = ("middle", "random")
ON_REWARD, ON_BUDGET, ON_STOP = ENDS = ("on_reward", "on_budget", "on_stop")
DEFAULT_PHANTOMS = range(4)
MAX_DRAWS = 1000
NO_ACTION = np.zeros(0)

Volumes = Mapping[str, LabelVolume] | Sequence[LabelVolume] | str | Path | None
Observed = NDArray[Any] | Parts


class Rules:
    """Rules of a single or vector environment; see `ArmscanEnv` for the arguments."""

    def __init__(
        self,
        volumes: Volumes = None,
        *,
        observation: ObservationLike = "cluster",
        flat: bool | None = None,
        projection: str | Sequence[str] = "y",
        reward: Reward | None = None,
        targets: Sequence[int] = PUBLISHED_TARGETS,
        clustering: str | Tissues = "pixels",
        success_threshold: float = SUCCESS_THRESHOLD,
        ends: str = ON_REWARD,
        max_steps: int = 50,
        start: str = "middle",
        rotation_bounds_deg: tuple[float, float] = (180.0, 180.0),
        translation_bounds_mm: tuple[float, float] | None = None,
        transform: RandomTransform | None = RandomTransform(),  # noqa: B008 - it is immutable
    ) -> None:
        self.volumes = named_volumes(volumes)
        self.names = list(self.volumes)
        self.success_threshold = check_float("success_threshold", success_threshold, above=0.0, at_most=1.0)
        self.ends = check_choice("ends", ends, ENDS)
        self.max_steps = check_int("max_steps", max_steps, at_least=1)
        self.start = check_choice("start", start, STARTS)
        self.tissues = check_tissues(clustering)
        self.reward = fitted_reward(reward, targets, self.volumes.values(), self.tissues)
        rotation = check_numbers("rotation_bounds_deg", rotation_bounds_deg, 2, "for rz and rx")
        if translation_bounds_mm is not None:
            translation = check_numbers("translation_bounds_mm", translation_bounds_mm, 2, "for tx and ty")
            translation_bounds_mm = (translation[0], translation[1])
        self._sampler = SceneSampler(
            rotation_bounds_deg=(rotation[0], rotation[1]),
            translation_bounds_mm=translation_bounds_mm,
            transform=transform,
        )
        self._scanner = Scanner(list(self.volumes.values()), self.tissues)
        self._index = {name: index for index, name in enumerate(self.names)}
        self._labelled_views: dict[str, View] = {}
        self._check_optimal_planes()
        self.free = free_components(projection)
        self.action_names = (*(COMPONENTS[i] for i in self.free), *([STOP] if ends == ON_STOP else []))
        self.action_space = spaces.Box(-1.0, 1.0, (len(self.action_names),), np.float32)
        self._geometries = {
            volume.name: SliceGeometry(volume.slice_shape, volume.pixel_mm) for volume in self.volumes.values()
        }
        self._smallest_shape = smallest_shape([each.shape for each in self._geometries.values()])
        self._observation = with_action_reward(observation, getattr(self.reward, "targets", PUBLISHED_TARGETS))
        boxes = self._observation.spaces(list(self._geometries.values()), len(self.action_names))
        self._shapes = {name: box.shape for name, box in boxes.items()}
        are_vectors = all(len(box.shape) == 1 for box in boxes.values())
        self._is_flat = are_vectors if flat is None else check_bool("flat", flat)
        self.observation_space: spaces.Box | MultiBoxSpace = (
            flat_space(boxes) if self._is_flat else MultiBoxSpace(boxes)
        )

    @property
    def n_steps(self) -> int | None:
        """Number of steps of an episode whose last plane is the answer; None if the first success ends it."""
        return None if self.ends == ON_REWARD else self.max_steps

    def look(self, scenes: Sequence[Scene], actions: Sequence[ManipulatorAction]) -> list[View]:
        """Look at one plane in each scene; several are looked at together, on all cores.

        The views' `action` is left empty.
        """
        if len(scenes) == 1:
            return [self.look_at(scenes[0], actions[0])]
        slices, landmarks = self._scanner.look_all(
            np.array([self._index[scene.volume.name] for scene in scenes]),
            np.array([action.rotation + action.translation for action in actions]),
            np.array([scene.maps for scene in scenes]),
        )
        return [self._view(*seen) for seen in zip(scenes, slices, landmarks, strict=True)]

    def look_at(self, scene: Scene, action: ManipulatorAction) -> View:
        """Look at one plane, as `look` does."""
        return self._view(scene, *self._scanner.look(self._index[scene.volume.name], action, scene.maps))

    @property
    def transform(self) -> RandomTransform | None:
        """The random motion of the volume at reset; None: no motion."""
        return self._sampler.transform

    @property
    def bounds(self) -> dict[str, ActionBounds]:
        """Bounds of the actions on each volume, by its name."""
        return {name: self._sampler.bounds(volume) for name, volume in self.volumes.items()}

    def draw_scenes(
        self, names: Sequence[str], rngs: Sequence[np.random.Generator]
    ) -> list[tuple[Scene, NDArray[np.uint8]]]:
        """Draw a scene of each named volume in which the optimal plane's reward is above -success_threshold.

        Args:
            names: Names of the volumes.
            rngs: Random generator of each scene.

        Returns:
            Each scene, and the slice of its optimal plane.

        Raises:
            OptimalPlaneError: If none of a thousand motions keeps the optimal plane within the bounds and its reward
                above -success_threshold.
        """
        drawn: dict[int, tuple[Scene, NDArray[np.uint8]]] = {}
        for _ in range(MAX_DRAWS):
            proposed = {
                i: scene
                for i, (name, rng) in enumerate(zip(names, rngs, strict=True))
                if i not in drawn and (scene := self._sampler.propose(self.volumes[name], rng)) is not None
            }
            if proposed:
                views = self._look_at_optima(list(proposed.values()))
                seen = zip(proposed.items(), views, strict=True)
                drawn |= {i: (scene, view.slice_xz) for (i, scene), view in seen if self.is_solved(view)}
            if len(drawn) == len(names):
                return [drawn[i] for i in range(len(names))]
        name = next(name for i, name in enumerate(names) if i not in drawn)
        raise OptimalPlaneError(
            f"{name}: no transform of {MAX_DRAWS} drawn from {self._sampler.transform} keeps the optimal plane within "
            f"the bounds {self._sampler.bounds(self.volumes[name])} and its reward above -success_threshold = "
            f"{-self.success_threshold:g}"
        )

    def _look_at_optima(self, scenes: Sequence[Scene]) -> list[View]:
        """Look at the optimal plane of each scene; the slice is not looked up again where it is the labelled one."""
        views = {i: self._labelled_view(scene.volume) for i, scene in enumerate(scenes) if shows_labelled(scene)}
        others = [i for i in range(len(scenes)) if i not in views]
        if others:
            looked = self.look([scenes[i] for i in others], [scenes[i].optimum for i in others])
            views |= dict(zip(others, looked, strict=True))
        return [views[i] for i in range(len(scenes))]

    def _labelled_view(self, volume: LabelVolume) -> View:
        """Return the view of the labelled plane in the unmoved volume."""
        if volume.name not in self._labelled_views:
            plane = volume.optimal_action
            assert plane is not None
            self._labelled_views[volume.name] = self.look_at(self._sampler.unmoved(volume), plane)
        return self._labelled_views[volume.name]

    def is_solved(self, view: View) -> bool:
        """Return whether a view's reward is a success."""
        return view.reward > -self.success_threshold

    def observe(self, view: View) -> Observed:
        """Return the observation of a view, within `observation_space`."""
        parts = in_order(self._observation.observe(view), self._shapes)
        return flatten({name: part.ravel() for name, part in parts.items()}) if self._is_flat else parts

    def observe_all(self, views: Sequence[View]) -> Observed:
        """Return the observations of many views, shape (n_views, ...)."""
        parts = in_order(observe_all(self._observation, views), self._shapes, (len(views),))
        if not self._is_flat:
            return parts
        return flatten({name: part.reshape(len(views), -1) for name, part in parts.items()})

    def _view(self, scene: Scene, slice_xz: NDArray[np.uint8], landmarks: Landmarks) -> View:
        volume = scene.volume
        return View(
            slice_xz=slice_xz,
            landmarks=landmarks,
            tissues=self.tissues,
            geometry=self._geometries[volume.name],
            smallest_shape=self._smallest_shape,
            action=NO_ACTION,
            reward=self._score(landmarks, volume),
        )

    def _score(self, landmarks: Landmarks, volume: LabelVolume) -> float:
        """Return the reward of a slice; raise `InvalidValueError` if a custom reward returns no number in [-1, 0]."""
        score = self.reward.score(landmarks, volume.pixel_mm)
        if type(score) is float and -1.0 <= score <= 0.0:
            return score
        return check_float(f"the score of {type(self.reward).__name__}", score, at_least=-1.0, at_most=0.0)

    def _check_optimal_planes(self) -> None:
        for volume in self.volumes.values():
            scene = self._sampler.unmoved(volume)
            _, landmarks = self._scanner.look(self._index[volume.name], scene.optimum)
            score = self._score(landmarks, volume)
            if score <= -self.success_threshold:
                counts = tuple(landmarks[:, 0].astype(int).tolist())
                raise OptimalPlaneError(
                    f"{volume.name}: the labelled plane scores {score:.3f} (bones, tendons, artery: {counts}), "
                    f"but it must score above -success_threshold = {-self.success_threshold:g}"
                )


def named_volumes(volumes: Volumes) -> dict[str, LabelVolume]:
    """Return volumes by name, given in any form that `ArmscanEnv` accepts."""
    if volumes is None:
        return load_phantoms(DEFAULT_PHANTOMS)
    if isinstance(volumes, str | Path):
        return read_dataset(volumes)
    if not isinstance(volumes, Mapping | list | tuple):
        raise InvalidValueError(f"volumes is {volumes!r}, but it must be volumes by name or in a list, or a folder")
    given = list(volumes.items()) if isinstance(volumes, Mapping) else [(None, volume) for volume in volumes]
    if not given:
        raise InvalidValueError("volumes is empty, but an environment needs at least one")
    for key, volume in given:
        if not isinstance(volume, LabelVolume):
            raise InvalidValueError(f"volumes holds {volume!r}, but each must be a LabelVolume")
        if key not in (None, volume.name):
            raise InvalidValueError(f"volumes holds {volume.name!r} as {key!r}, but it must be under its name")
    named = {volume.name: volume for _, volume in given}
    if len(named) < len(given):
        raise InvalidValueError(f"volumes holds two of the same name among {listed(v.name for _, v in given)}")
    return named
