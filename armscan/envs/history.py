"""History of episodes, for a batch of environments: the last observations, the best actions."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from armscan.envs.spaces import MultiBoxSpace, Parts, flat_space
from armscan.errors import InvalidValueError, listed
from armscan.utils.validation import check_int

FLAT = ""
"""Key in `Parts` of an observation that is one vector."""

MEMORY = "memory"
# Observations of a stack, and pairs of a memory.
MAX_KEPT = 1000
Mask = NDArray[np.bool_]
EnvIds = NDArray[np.int64]


def boxes_of(space: spaces.Space[Any], who: str) -> dict[str, spaces.Box]:
    """Return the boxes of a vector or `Dict` space by name; that of a vector is `FLAT`.

    Args:
        space: Observation space.
        who: Name of the wrapper, for the message.

    Raises:
        InvalidValueError: If the space is of another kind.
    """
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        return {FLAT: space}
    if isinstance(space, spaces.Dict):
        boxes = {name: box for name, box in space.items() if isinstance(box, spaces.Box)}
        if len(boxes) == len(space):
            return boxes
    raise InvalidValueError(f"{who} wraps observations that are vectors or a Dict of boxes, but the space is {space}")


def space_of(boxes: Mapping[str, spaces.Box]) -> spaces.Box | MultiBoxSpace:
    """Return the space of these boxes: the inverse of `boxes_of`."""
    return boxes[FLAT] if FLAT in boxes else MultiBoxSpace(boxes)


def parts_of(observation: NDArray[Any] | Parts) -> Parts:
    """Return the parts of an observation by name."""
    return observation if isinstance(observation, dict) else {FLAT: observation}


def observation_of(parts: Parts) -> NDArray[Any] | Parts:
    """Return the observation of these parts: the inverse of `parts_of`."""
    return parts.get(FLAT, parts)


def check_exclusions(excluded: Any, boxes: Mapping[str, spaces.Box]) -> frozenset[str]:
    """Return the names of the parts excluded from stacking, each of which must be in `boxes`."""
    named = [name for name in boxes if name != FLAT]
    is_collection = isinstance(excluded, list | tuple | set | frozenset)
    if not is_collection or not all(isinstance(name, str) and name in named for name in excluded):
        raise InvalidValueError(
            f"stack_exclude is {excluded!r}, but it must be "
            f"{f'a list of {listed(named)}' if named else 'empty, because the observation is one vector'}"
        )
    return frozenset(excluded)


def rows_of(observations: NDArray[Any] | Parts, rows: int | NDArray[Any]) -> NDArray[Any] | Parts:
    """Return rows of a batch of observations, by indices or a mask; for a single index, that observation."""
    return observation_of({name: part[rows] for name, part in parts_of(observations).items()})


class EpisodeHistory(Protocol):
    """History of the episodes of a batch of environments, kept by a wrapper.

    Arguments and results have a row for each of the environments in `env_ids`, an array of their indices.
    """

    boxes: dict[str, spaces.Box]
    """Space of each part of one environment's observation with its history."""

    def refill(self, parts: Parts, infos: Mapping[str, Any], env_ids: EnvIds) -> None:
        """Start over with the first observations of some environments."""

    def push(self, parts: Parts, infos: Mapping[str, Any], env_ids: EnvIds) -> None:
        """Add the latest observation and `info` of environments."""

    def added_to(self, parts: Parts, env_ids: EnvIds) -> Parts:
        """Return the latest observations with their history, in arrays that are not reused."""


class FrameHistory:
    """The last observations of a batch of environments, from the oldest to the latest.

    Args:
        boxes: Space of each part of one environment.
        size: Number of observations, from 1 to 1000.
        excluded: Parts that are not stacked.
        n_envs: Number of environments of the batch.
    """

    def __init__(self, boxes: Mapping[str, spaces.Box], size: int, excluded: Collection[str], n_envs: int) -> None:
        self._size = size = check_int("stack", size, at_least=1, at_most=MAX_KEPT)
        excluded = check_exclusions(excluded, boxes)
        stacked = {name: box for name, box in boxes.items() if name not in excluded}
        # A ring buffer for each environment, because not all of them take every step.
        self._frames = {name: np.empty((n_envs, size, *box.shape), box.dtype) for name, box in stacked.items()}
        self._latest = np.full(n_envs, size - 1)
        # For each position of the latest one, the positions from the oldest, which is overwritten next, to the latest.
        self._places = (np.arange(size)[:, None] + np.arange(1, size + 1)) % size
        self.boxes = {**boxes, **{name: self._stacked_box(name, box) for name, box in stacked.items()}}

    def refill(self, parts: Parts, infos: Mapping[str, Any], env_ids: EnvIds) -> None:
        """See `EpisodeHistory.refill`."""
        for name, frames in self._frames.items():
            frames[env_ids] = parts[name][:, None]

    def push(self, parts: Parts, infos: Mapping[str, Any], env_ids: EnvIds) -> None:
        """See `EpisodeHistory.push`."""
        self._latest[env_ids] = latest = (self._latest[env_ids] + 1) % self._size
        for name, frames in self._frames.items():
            frames[env_ids, latest] = parts[name]

    def added_to(self, parts: Parts, env_ids: EnvIds) -> Parts:
        """Return the latest observations of these n environments; stacked parts have the shape (n, size, ...).

        A stacked vector has the shape (n, size * length).
        """
        places = self._places[self._latest[env_ids]]
        return {
            name: self._stack(name, env_ids, places) if name in self._frames else part for name, part in parts.items()
        }

    def _stack(self, name: str, env_ids: EnvIds, places: NDArray[np.int64]) -> NDArray[Any]:
        stack = self._frames[name][env_ids[:, None], places]
        return stack.reshape(len(stack), -1) if name == FLAT else stack

    def _stacked_box(self, name: str, box: spaces.Box) -> spaces.Box:
        low, high = (np.repeat(bound[None], self._size, axis=0) for bound in (box.low, box.high))
        if name == FLAT:
            low, high = low.ravel(), high.ravel()
        return spaces.Box(low, high, dtype=box.dtype)


class BestPairs:
    """The best (action, reward) pairs of the current episode of each environment of a batch.

    They are ordered from the best to the worst, and with equal rewards from the earliest to the latest. At first, all
    are the pair of the first plane; a new pair enters only if its reward beats the worst one kept.

    Args:
        boxes: Space of each part of one environment.
        size: Number of pairs of action and reward, from 1 to 1000.
        action_space: Space of one action, `stop` included.
        n_envs: Number of environments of the batch.
    """

    def __init__(self, boxes: dict[str, spaces.Box], size: int, action_space: spaces.Space[Any], n_envs: int) -> None:
        check_int("memory", size, at_least=1, at_most=MAX_KEPT)
        if MEMORY in boxes:
            raise InvalidValueError(f"the observation already has a part {MEMORY!r}, which BestActionMemory adds")
        n_action = int(np.prod(action_space.shape or ()))
        self.pairs = np.zeros((n_envs, size, n_action + 1), dtype=np.float32)
        low, high = [-1.0] * (n_action + 1), [1.0] * n_action + [0.0]
        box = spaces.Box(np.tile(low, size).astype(np.float32), np.tile(high, size).astype(np.float32))
        self.boxes = {FLAT: flat_space({**boxes, MEMORY: box})} if FLAT in boxes else {**boxes, MEMORY: box}

    def refill(self, parts: Parts, infos: Mapping[str, Any], env_ids: EnvIds) -> None:
        """Fill all pairs of environments that begin an episode with the first plane's."""
        self.pairs[env_ids] = self._paired(infos, env_ids)[:, None]

    def push(self, parts: Parts, infos: Mapping[str, Any], env_ids: EnvIds) -> None:
        """Add the latest pair of each environment in which it beats the worst one kept."""
        latest = self._paired(infos, env_ids)
        enters = (latest[:, -1] > self.pairs[:, -1, -1][env_ids]).nonzero()[0]
        if len(enters):
            where = env_ids[enters]
            self.pairs[where, -1] = latest[enters]
            order = np.argsort(-self.pairs[where, :, -1], axis=1, kind="stable")
            self.pairs[where] = np.take_along_axis(self.pairs[where], order[:, :, None], axis=1)

    def added_to(self, parts: Parts, env_ids: EnvIds) -> Parts:
        """Return the latest observations with each environment's (action, reward) pairs, flattened, the best first."""
        pairs = self.pairs[env_ids].reshape(len(env_ids), -1)
        return {FLAT: np.concatenate([parts[FLAT], pairs], axis=-1)} if FLAT in parts else {**parts, MEMORY: pairs}

    def _paired(self, infos: Mapping[str, Any], env_ids: EnvIds) -> NDArray[np.float32]:
        pairs = np.empty((len(env_ids), self.pairs.shape[-1]), dtype=np.float32)
        pairs[:, :-1], pairs[:, -1] = infos["action"], infos["reward"]
        return pairs
