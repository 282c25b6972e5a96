"""Tianshou's replay buffer, seeded, with episodes cut off at the end of an epoch, and a state for checkpoints."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tianshou.algorithm.algorithm_base import _gae, _nstep_return
from tianshou.data import Batch, VectorReplayBuffer
from tianshou.data.buffer.manager import _next_index, _prev_index

# Cached on disk; otherwise each process would compile them for five seconds.
for _compiled in (_gae, _nstep_return, _next_index, _prev_index):
    _compiled.enable_caching()

Tree = dict[str, Any]
"""Nested dicts of tensors."""
Added = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]


class Replay(VectorReplayBuffer):
    """At most `total_size` transitions of `buffer_num` environments, with a ring buffer for each environment."""

    def hasnull(self) -> bool:
        """Return False without searching for NaN.

        Tianshou's collectors call this at every collection, and a search takes longer the fuller the buffer is.
        Weights that have diverged are found after each epoch.
        """
        return False

    def add(self, batch: Any, buffer_ids: Any = None) -> Added:
        """Add a transition of each of these environments; default: of all.

        Args:
            batch: Parts of the transitions by name, a `Batch` or a dict, each of shape (n, ...).
            buffer_ids: Environments of the transitions, shape (n,). Default: None, all environments.

        Returns:
            Indices of the transitions; returns and lengths of the episodes that end with them, 0 for others; and first
            indices of the episodes.
        """
        if not self._meta.get_keys():
            first: Added = super().add(Batch(batch), buffer_ids)
            return first
        ids = np.arange(self.buffer_num) if buffer_ids is None else np.asarray(buffer_ids)
        rings = self.buffers[ids]
        ends = np.logical_or(batch["terminated"], batch["truncated"])
        added = [ring._update_state_pre_add(*each) for ring, *each in zip(rings, batch["rew"], ends, strict=True)]
        places, returns, lengths, starts = (np.array(each) for each in zip(*added, strict=True))
        places += self._offset[ids]
        self.last_index[ids], self._lengths[ids] = places, [len(ring) for ring in rings]
        _write(self._meta, batch, places)
        return places, returns, lengths, starts + self._offset[ids]

    def seed(self, seed: int) -> None:
        """Seed the generators of the buffer and of its rings, each with a child of the seed."""
        children = np.random.SeedSequence(seed).spawn(1 + len(self.buffers))
        for ring, child in zip((self, *self.buffers), children, strict=True):
            ring._random_state.seed(child.generate_state(1))

    def sample_indices(self, batch_size: int | None) -> NDArray[np.int64]:
        """Return indices of transitions, drawn uniformly with replacement; all in order if `batch_size` is 0.

        Tianshou samples each ring separately, which costs a fifth of a compiled update.
        """
        if not batch_size:
            in_order: NDArray[np.int64] = super().sample_indices(batch_size)
            return in_order
        ends = np.cumsum(self._lengths)
        drawn = self._random_state.randint(0, ends[-1], batch_size)
        ring = np.searchsorted(ends, drawn, side="right")
        indices: NDArray[np.int64] = drawn + (self._offset - ends + self._lengths)[ring]
        return indices

    def cut_off(self) -> None:
        """Mark episodes that have not ended as truncated, because their environments are reset."""
        if len(self):
            unfinished = self.unfinished_index()
            self.truncated[unfinished] = self.done[unfinished] = True
        for ring in self.buffers:
            ring._ep_return, ring._ep_len, ring._ep_start_idx = 0.0, 0, ring._insertion_idx

    def state(self) -> Tree:
        """Return all transitions and the position at which each ring continues; call `cut_off` before."""
        rings = [(ring._insertion_idx, len(ring), int(ring.last_index[0])) for ring in self.buffers]
        return {"transitions": _tensors(self._meta) if len(self) else {}, "rings": rings}

    def load_state(self, state: Tree) -> None:
        """Restore what `state` returned."""
        self.reset()
        if state["transitions"]:
            self.set_batch(_batch(state["transitions"]))
        for i, (ring, (insertion, length, last)) in enumerate(zip(self.buffers, state["rings"], strict=True)):
            ring._insertion_idx, ring._size, ring.last_index = insertion, length, np.array([last])
            ring._ep_start_idx = insertion
            self._lengths[i], self.last_index[i] = length, self._offset[i] + last


def _write(kept: Any, parts: Any, places: NDArray[np.int64]) -> None:
    """Write parts of transitions to their indices."""
    for name, part in parts.items():
        if isinstance(part, Batch | dict):
            # `kept` may lack empty parts: a checkpoint leaves them out.
            _write(kept.get(name), part, places)
        else:
            kept[name][places] = part


def _tensors(batch: Any) -> Tree:
    """Return the arrays of a batch as tensors; empty parts are left out."""
    return {
        name: _tensors(part) if isinstance(part, Batch) else torch.from_numpy(part)
        for name, part in batch.items()
        if not (isinstance(part, Batch) and len(part.get_keys()) == 0)
    }


def _batch(tree: Tree) -> Batch:
    return Batch({name: _batch(part) if isinstance(part, dict) else part.numpy() for name, part in tree.items()})
