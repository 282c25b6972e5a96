"""Sizes of the convolutions of images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

# Kernel and stride of each convolution.
CONVOLUTIONS = ((8, 4), (4, 2), (3, 1))


def smallest_side_px() -> int:
    """Return the smallest image side, in pixels, of which the convolutions leave at least one pixel."""
    side = 1
    for kernel, stride in reversed(CONVOLUTIONS):
        side = (side - 1) * stride + kernel
    return side


def images_of(space: spaces.Space[Any]) -> dict[str, spaces.Box]:
    """Return the images among the parts of an observation, by name: those of bytes, with two axes or more."""
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    return {
        name: box
        for name, box in parts.items()
        if isinstance(box, spaces.Box) and box.dtype == np.uint8 and len(box.shape) >= 2
    }


def count_features(box: spaces.Box, filters: Sequence[int]) -> int:
    """Return the number of features that the convolutions compute from an image."""
    sides = np.array(box.shape[-2:])
    for kernel, stride in CONVOLUTIONS:
        sides = (sides - kernel) // stride + 1
    return filters[-1] * int(np.prod(sides))
