"""Store of image frames, run-length encoded and reference-counted."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from armscan.utils.compilation import cached_njit

Pixels = NDArray[np.uint8]
NO_FRAME = 0
"""ID in slots of a replay buffer that were never written: no frame."""
MAX_IN_A_BYTE, MAX_IN_TWO = np.uint64(255), np.uint64(65535)


def encode(pixels: Pixels) -> bytes:
    """Return a frame run-length encoded, without the runs of value 0, so that an empty frame takes no bytes.

    Three bytes describe a run: its distance from the end of the previous one (at most 255 pixels), its length (at most
    255) and its value. If the length is 0, they describe a gap of (first byte + 256 * third byte) pixels.
    If this takes no fewer bytes than there are pixels, the pixels themselves are returned.

    Args:
        pixels: Pixels of one frame, shape (n_pixels,).
    """
    buffer = np.empty(pixels.size, dtype=np.uint8)
    n_bytes = _encode(pixels, buffer)
    return (buffer[:n_bytes] if n_bytes < pixels.size else pixels).tobytes()


def decode(frames: list[bytes], n_pixels: int) -> Pixels:
    """Return the pixels of frames that `encode` returned, shape (n, n_pixels), in one compiled call."""
    ends = np.cumsum(np.fromiter(map(len, frames), dtype=np.uint64, count=len(frames)))
    pixels = np.empty((len(frames), n_pixels), dtype=np.uint8)
    _decode(np.frombuffer(b"".join(frames), dtype=np.uint8), ends, pixels)
    return pixels


# Positions are unsigned: numba's handling of negative indices would cost more than all the rest.
@cached_njit(nogil=True)
def _encode(pixels: Pixels, buffer: Pixels) -> int:
    """Write the runs; return their number of bytes, or the number of pixels if they need at least as many."""
    n_pixels, n_bytes, i = np.uint64(pixels.size), np.uint64(0), np.uint64(0)
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    while True:
        start = i
        while start < n_pixels and pixels[start] == 0:
            start += one
        if start == n_pixels:
            return int(n_bytes)
        if n_bytes + three >= n_pixels:
            return int(n_pixels)
        gap = start - i
        if gap > MAX_IN_A_BYTE:
            gap = min(gap, MAX_IN_TWO)
            i += gap
            length, value = np.uint64(0), np.uint8(gap >> np.uint64(8))
        else:
            i, value = start, pixels[start]
            while i < n_pixels and i - start < MAX_IN_A_BYTE and pixels[i] == value:
                i += one
            length = i - start
        buffer[n_bytes], buffer[n_bytes + one], buffer[n_bytes + two] = gap & MAX_IN_A_BYTE, length, value
        n_bytes += three


@cached_njit(nogil=True)
def _decode(joined: Pixels, ends: NDArray[np.uint64], pixels: Pixels) -> None:
    """Decode frames into `pixels`; `ends` says where the bytes of each end in `joined`."""
    n_pixels, at = np.uint64(pixels.shape[1]), np.uint64(0)
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    for k in range(len(ends)):
        frame, end = pixels[k], ends[k]
        if end - at == n_pixels:
            for pixel in range(n_pixels):
                frame[pixel] = joined[at + np.uint64(pixel)]
            at = end
            continue
        frame[:] = 0
        i = np.uint64(0)
        # Invalid bytes never cause a read or write outside the frame.
        while at + two < end:
            i += np.uint64(joined[at])
            length, value = np.uint64(joined[at + one]), joined[at + two]
            at += three
            if length == 0:
                i += np.uint64(value) << np.uint64(8)
            run_end = min(i + length, n_pixels)
            while i < run_end:
                frame[i] = value
                i += one
        at = end


class FrameStore:
    """Frames of `n_pixels` by ID; each is dropped with its last reference."""

    def __init__(self, n_pixels: int) -> None:
        self._n_pixels = n_pixels
        self.clear()

    def clear(self) -> None:
        """Forget every frame."""
        # Indexed by ID; the first is `NO_FRAME`.
        self._frames = [b""]
        self._n_references = [0]
        self._free: list[int] = []

    def __len__(self) -> int:
        return len(self._frames) - 1 - len(self._free)

    @property
    def n_bytes(self) -> int:
        """Bytes of all stored frames, without Python's overhead for each."""
        return sum(map(len, self._frames))

    def add(self, pixels: Pixels) -> int:
        """Store a frame, shape (n_pixels,), without references yet; return its ID."""
        frame = encode(pixels)
        if self._free:
            frame_id = self._free.pop()
            self._frames[frame_id] = frame
            return frame_id
        self._frames.append(frame)
        self._n_references.append(0)
        return len(self._frames) - 1

    def hold(self, ids: Iterable[int]) -> None:
        """Count a reference to each of these frames."""
        for frame_id in ids:
            self._n_references[frame_id] += 1

    def release(self, ids: Iterable[int]) -> None:
        """Remove a reference to each of these frames; drop frames without references."""
        for frame_id in ids:
            if frame_id == NO_FRAME:
                continue
            self._n_references[frame_id] -= 1
            if not self._n_references[frame_id]:
                self._frames[frame_id] = b""
                self._free.append(frame_id)

    def decode(self, ids: NDArray[np.int32]) -> Pixels:
        """Return the frames of these IDs, shape (*ids.shape, n_pixels)."""
        frames = [self._frames[frame_id] for frame_id in ids.ravel().tolist()]
        return decode(frames, self._n_pixels).reshape(*ids.shape, self._n_pixels)

    def state(self) -> dict[str, Any]:
        """Return all frames, joined, and which IDs are free, as tensors."""
        return {
            "joined": torch.from_numpy(np.frombuffer(bytearray().join(self._frames), dtype=np.uint8)),
            "lengths": torch.tensor([len(frame) for frame in self._frames]),
            "n_references": torch.tensor(self._n_references),
            "free": torch.tensor(self._free, dtype=torch.int64),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        joined = memoryview(state["joined"].numpy())
        ends = state["lengths"].cumsum(0).tolist()
        self._frames = [bytes(joined[start:end]) for start, end in zip([0, *ends], ends, strict=False)]
        self._n_references = state["n_references"].tolist()
        self._free = state["free"].tolist()
