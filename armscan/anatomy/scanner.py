"""Compiled look at a plane: its slice and the summary of its clusters; for one plane, or for many on all cores."""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numpy.typing import NDArray

from armscan.anatomy.clustering import bounding_boxes, summarise_label
from armscan.anatomy.connected_components import WORD, IntArray, Pixels
from armscan.anatomy.landmarks import Landmarks
from armscan.anatomy.tissues import N_TISSUES, Neighbourhood, Tissues
from armscan.errors import InvalidValueError
from armscan.utils.arrays import FloatArray
from armscan.utils.compilation import cached_njit
from armscan.volumes.plane import ManipulatorAction
from armscan.volumes.rigid_transform import NO_MAPS, mapped_plane
from armscan.volumes.slicing import sample_plane
from armscan.volumes.volume import LabelVolume

Depths = NDArray[np.int32]
# Planes that a thread takes at once: few, so that other threads take over from one on a busy core, but enough to be
# worth waking a thread.
N_AT_ONCE = 4


@cached_njit(nogil=True)
def _look(
    labels_yxz: Pixels,
    occupied: Depths,
    which: int,
    rotation: tuple[float, float],
    translation: tuple[float, float],
    maps: FloatArray,
    spacings_mm: FloatArray,
    tissue_labels: IntArray,
    half_widths: IntArray,
    min_samples: IntArray,
    slice_xz: Pixels,
    landmarks: Landmarks,
) -> None:
    """Fill a slice and its summary; `half_widths` has a row for each volume and tissue, padded with -1."""
    s_x, s_y, s_z = spacings_mm[which]
    matrix, offset_mm = mapped_plane(maps, rotation, translation)
    sample_plane(labels_yxz, occupied, (s_x, s_y, s_z), matrix, offset_mm, slice_xz)
    boxes = bounding_boxes(slice_xz, tissue_labels)
    for tissue in range(tissue_labels.size):
        label, widths = tissue_labels[tissue], half_widths[which, tissue]
        widths = widths[: np.sum(widths >= 0)]
        summarise_label(slice_xz, label, boxes[tissue], widths, min_samples[which, tissue], landmarks[tissue])


@cached_njit(nogil=True)
def _look_all(
    volumes: Sequence[tuple[Pixels, Depths]],
    which: IntArray,
    planes: FloatArray,
    maps: FloatArray,
    spacings_mm: FloatArray,
    tissue_labels: IntArray,
    half_widths: IntArray,
    min_samples: IntArray,
    slices: Pixels,
    landmarks: FloatArray,
) -> None:
    """Look at each plane i in volume `which[i]`, as `_look` does; row i of `slices` begins with slice i."""
    rules = spacings_mm, tissue_labels, half_widths, min_samples
    for i in range(which.size):
        labels_yxz, occupied = volumes[which[i]]
        _, n_across, n_depth = labels_yxz.shape
        slice_xz = slices[i, : n_across * n_depth].reshape((n_across, n_depth))
        rz, rx, tx, ty = planes[i]
        _look(labels_yxz, occupied, which[i], (rz, rx), (tx, ty), maps[i], *rules, slice_xz, landmarks[i])


@functools.cache
def _threads(pid: int, n_threads: int) -> ThreadPoolExecutor:
    """Return the thread pool of a process; a fork does not inherit its parent's threads.

    Numba's own pool would kill a forked process: GNU OpenMP cannot be used both before and after a fork.
    """
    return ThreadPoolExecutor(n_threads, thread_name_prefix=f"scanner-{pid}")


def _neighbourhoods(volume: LabelVolume, tissues: Tissues) -> list[Neighbourhood]:
    try:
        return [tissue.neighbourhood(volume.pixel_mm) for tissue in tissues]
    except InvalidValueError as error:
        raise InvalidValueError(f"{volume.name}: {error}") from error


class Scanner:
    """Samples planes of volumes and clusters what they show.

    Args:
        volumes: Volumes; planes name them by their index in this sequence.
        tissues: Clustering rule of each tissue.
    """

    def __init__(self, volumes: Sequence[LabelVolume], tissues: Tissues) -> None:
        self.volumes = tuple(volumes)
        self._shapes = [volume.slice_shape for volume in self.volumes]
        rules = [_neighbourhoods(volume, tissues) for volume in self.volumes]
        longest = max(len(rule.half_widths) for each in rules for rule in each)
        half_widths = np.full((len(rules), len(tissues), longest), -1, dtype=np.int64)
        for volume, each in enumerate(rules):
            for tissue, rule in enumerate(each):
                half_widths[volume, tissue, : len(rule.half_widths)] = rule.half_widths
        self._rules = (
            np.array([volume.spacing for volume in self.volumes]),
            np.array([tissue.label for tissue in tissues]),
            half_widths,
            np.array([[rule.min_samples for rule in each] for each in rules]),
        )
        self._typed_volumes: numba.typed.List | None = None

    def look(self, which: int, plane: ManipulatorAction, maps: FloatArray = NO_MAPS) -> tuple[Pixels, Landmarks]:
        """Look at one plane.

        Args:
            which: Index of the volume.
            plane: Plane in the frame of the moved volume.
            maps: Motion of the volume, `RigidTransform.maps`. Default: none.

        Returns:
            The slice, indexed [across, depth], and the summary of its clusters.
        """
        slice_xz = np.empty(self._shapes[which], dtype=np.uint8)
        landmarks = np.empty((N_TISSUES, 4))
        volume = self.volumes[which]
        where = which, plane.rotation, plane.translation, maps
        _look(volume.labels_yxz, volume.occupied, *where, *self._rules, slice_xz, landmarks)
        return slice_xz, landmarks

    def look_all(self, which: IntArray, planes: FloatArray, maps: FloatArray) -> tuple[list[Pixels], FloatArray]:
        """Look at n planes on NUMBA_NUM_THREADS threads; default: one for each core.

        Args:
            which: Index of each plane's volume, shape (n,).
            planes: Angles (rz, rx) in degrees and offsets (tx, ty) in mm of each plane, shape (n, 4).
            maps: Motion of each plane's volume, `RigidTransform.maps`, shape (n, n_maps, 3, 4).

        Returns:
            The slices, and the summaries of their clusters, shape (n, 3, 4): bit for bit what `look` gives.
        """
        # Numba's default is the number of cores that this process may use.
        n_threads = int(os.environ.get("NUMBA_NUM_THREADS") or vars(numba.config)["NUMBA_DEFAULT_NUM_THREADS"])
        n_at_once = N_AT_ONCE if n_threads > 1 else len(which)
        if self._typed_volumes is None:
            self._typed_volumes = numba.typed.List([(each.labels_yxz, each.occupied) for each in self.volumes])
        volumes = self._typed_volumes
        shapes = [self._shapes[i] for i in which]
        longest = max(n_across * n_depth for n_across, n_depth in shapes)
        # Rows are whole words, so that each row is aligned.
        slices = np.empty((len(which), -(-longest // WORD) * WORD), dtype=np.uint8)
        landmarks = np.empty((len(which), N_TISSUES, 4))

        starts = iter(range(0, len(which), n_at_once))

        def look_at_rest() -> None:
            for start in starts:
                part = slice(start, start + n_at_once)
                where = which[part], planes[part], maps[part]
                _look_all(volumes, *where, *self._rules, slices[part], landmarks[part])

        n_helpers = min(n_threads, -(-len(which) // n_at_once)) - 1
        helpers = [_threads(os.getpid(), n_threads).submit(look_at_rest) for _ in range(n_helpers)]
        look_at_rest()
        for helper in helpers:
            # A helper that has not begun would find nothing left.
            if not helper.cancel():
                helper.result()
        return [
            row[: n_across * n_depth].reshape(n_across, n_depth)
            for row, (n_across, n_depth) in zip(slices, shapes, strict=True)
        ], landmarks

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_typed_volumes": None}
