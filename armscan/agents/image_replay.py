"""Replay buffer for image observations: frames are compressed, and shared between stacks and steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from tianshou.data import Batch

from armscan.agents.convolutions import images_of
from armscan.agents.frame_store import FrameStore, Pixels
from armscan.agents.replay import Added, Replay, Tree

OBSERVATIONS = ("obs", "obs_next")
Seen = list[tuple[bytes, int]]
"""Pixels of frames with their IDs."""


def replay_for(observation_space: spaces.Space[Any], size: int, n_envs: int) -> Replay:
    """Return the replay buffer for these observations: a plain one if they have no images."""
    images = images_of(observation_space)
    return ImageReplay(size, n_envs, images) if images else Replay(size, n_envs)


class ImageReplay(Replay):
    """A `Replay` that stores IDs of frames instead of images, and returns the images unchanged.

    An image of three axes or more is a sequence of frames along its first axis, such as a stack; one of two axes is a
    single frame. Most frames also occur in the previous stack, or in the next observation of the last step. They are
    recognised by their pixels, with any kind of stack, and stored once. A frame is dropped when the last transition
    that shows it is overwritten.

    Consecutive requests for the same transitions share the memory of their images.

    Args:
        size: Total number of transitions.
        n_envs: Number of environments.
        images: Names of the observation's parts that are images.
    """

    def __init__(self, size: int, n_envs: int, images: Mapping[str, spaces.Box]) -> None:
        super().__init__(size, n_envs)
        self._images = {name: _ImageStore(box.shape, n_envs) for name, box in images.items()}
        # The latest request, by key and name: IDs and images. An update asks for each batch twice.
        self._last: dict[tuple[str, str], tuple[NDArray[np.int32], Pixels]] = {}

    def add(self, batch: Any, buffer_ids: Any = None) -> Added:
        """See `Replay.add`."""
        envs = range(self.buffer_num) if buffer_ids is None else [int(i) for i in buffer_ids]
        slots = [self._offset[i] + self.buffers[i]._insertion_idx for i in envs]
        self._last.clear()
        ids: dict[str, Any] = {key: dict(batch[key].items()) for key in OBSERVATIONS}
        overwritten = {}
        for name, images in self._images.items():
            overwritten[name] = self._ids(name, slots) if len(self._meta.get_keys()) else []
            taken = [
                images.take_in(env, obs, obs_next)
                for env, obs, obs_next in zip(envs, *(batch[key][name] for key in OBSERVATIONS), strict=True)
            ]
            for k, key in enumerate(OBSERVATIONS):
                ids[key][name] = np.array([of_transition[k] for of_transition in taken], dtype=np.int32)
        added = super().add({**dict(batch.items()), **ids}, buffer_ids)
        # Only now: a new transition may refer to an overwritten frame.
        for name, images in self._images.items():
            images.frames.release(overwritten[name])
        return added

    def get(self, index: Any, key: str, default_value: Any = None, stack_num: int | None = None) -> Any:
        """Return one part of transitions, with its images decoded."""
        found: Any = super().get(index, key, default_value, stack_num)
        if key not in OBSERVATIONS:
            return found
        return Batch(dict(found.items()) | {name: self._decoded(key, name, found[name]) for name in self._images})

    def reset(self, keep_statistics: bool = False) -> None:
        """Forget every transition."""
        super().reset(keep_statistics)
        self._last.clear()
        for name, images in self._images.items():
            images.frames.clear()
            images.forget_last()
            for key in OBSERVATIONS if len(self._meta.get_keys()) else ():
                self._meta[key][name][:] = 0

    def cut_off(self) -> None:
        """See `Replay.cut_off`."""
        super().cut_off()
        # New episodes begin. A resumed training has no last frames, so an uninterrupted one must not use them either.
        for images in self._images.values():
            images.forget_last()

    def state(self) -> Tree:
        """See `Replay.state`."""
        return super().state() | {"frames": {name: images.frames.state() for name, images in self._images.items()}}

    def load_state(self, state: Tree) -> None:
        """See `Replay.load_state`."""
        super().load_state(state)
        for name, images in self._images.items():
            images.frames.load_state(state["frames"][name])

    def _ids(self, name: str, slots: list[int]) -> list[int]:
        """Return the IDs of all frames that transitions refer to, one for each reference."""
        return [frame_id for key in OBSERVATIONS for frame_id in self._meta[key][name][slots].ravel().tolist()]

    def _decoded(self, key: str, name: str, ids: NDArray[np.int32]) -> Pixels:
        last = self._last.get((key, name))
        if last is not None and np.array_equal(last[0], ids):
            return last[1]
        images = self._images[name].decode(ids)
        self._last[key, name] = ids.copy(), images
        return images


class _ImageStore:
    """Frames of one image part of the observations, whose images have one shape."""

    def __init__(self, shape: tuple[int, ...], n_envs: int) -> None:
        self._shape = shape
        self._n_frames = shape[0] if len(shape) > 2 else 1
        self._n_envs = n_envs
        self.frames = FrameStore(int(np.prod(shape)) // self._n_frames)
        self.forget_last()

    def forget_last(self) -> None:
        """Forget the last frames of every environment."""
        self._last: list[Seen] = [[] for _ in range(self._n_envs)]

    def take_in(self, env: int, image: Pixels, image_next: Pixels) -> tuple[list[int], list[int]]:
        """Store the images of a transition; return the IDs of their frames."""
        seen = list(self._last[env])
        ids, ids_next = (self._ids(part.reshape(self._n_frames, -1), seen) for part in (image, image_next))
        self.frames.hold(ids + ids_next)
        self._last[env] = seen[-self._n_frames :]
        return ids, ids_next

    def decode(self, ids: NDArray[np.int32]) -> Pixels:
        """Return images; `ids` has the frames of each along its last axis."""
        return self.frames.decode(ids).reshape(*ids.shape[:-1], *self._shape)

    def _ids(self, frames: Pixels, seen: Seen) -> list[int]:
        """Return the IDs of an image's frames, shape (n_frames, n_pixels), and add them to those seen."""
        first = len(seen)
        for frame in frames:
            pixels = frame.tobytes()
            found = (frame_id for known, frame_id in seen if known == pixels)
            seen.append((pixels, next(found, None) or self.frames.add(frame)))
        return [frame_id for _, frame_id in seen[first:]]
