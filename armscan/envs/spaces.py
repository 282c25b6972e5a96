"""The spaces of observations: boxes by name, and one flat box."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from armscan.errors import InvalidValueError

Parts = dict[str, NDArray[Any]]
"""Parts of an observation by name."""


class MultiBoxSpace(spaces.Dict):
    """A `Dict` space that holds only `Box` spaces.

    Args:
        boxes: Boxes by the name of their part.

    Raises:
        InvalidValueError: If there are none, or a value is not a `Box`.
    """

    def __init__(self, boxes: Mapping[str, spaces.Box]) -> None:
        if not isinstance(boxes, Mapping) or not boxes:
            raise InvalidValueError(f"boxes is {boxes!r}, but it must be at least one Box by name")
        for name, box in boxes.items():
            if not isinstance(name, str) or not isinstance(box, spaces.Box):
                raise InvalidValueError(f"{name!r} is {box!r}, but a MultiBoxSpace holds a Box under each name")
        super().__init__(dict(boxes))

    @property
    def shape(self) -> list[tuple[int, ...]]:  # type: ignore[override]
        """The boxes' shapes, in the order of the names."""
        return list(self.shapes.values())

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The boxes' shapes by name."""
        return {name: box.shape or () for name, box in self.spaces.items()}


def in_order(parts: Parts, shapes: Mapping[str, tuple[int, ...]], leading: tuple[int, ...] = ()) -> Parts:
    """Return the parts of an observation in the order of `shapes`, each checked to have shape (*leading, *shape)."""
    if parts.keys() != shapes.keys():
        raise InvalidValueError(
            f"the observation gave the parts {', '.join(parts)}, but its spaces are of {', '.join(shapes)}"
        )
    ordered = {}
    for name, shape in shapes.items():
        ordered[name] = part = np.asarray(parts[name])
        if part.shape != leading + shape:
            raise InvalidValueError(
                f"the observation gave {name} of shape {part.shape}, but its space has shape {leading + shape}"
            )
    return ordered


def flat_space(boxes: Mapping[str, spaces.Box]) -> spaces.Box:
    """Return the space of flattened observations, with the bounds of all parts in their order; see `flatten`."""
    low = np.concatenate([box.low.ravel() for box in boxes.values()])
    high = np.concatenate([box.high.ravel() for box in boxes.values()])
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def flatten(parts: Parts) -> NDArray[np.float32]:
    """Concatenate parts, each of shape (..., n), in their order, as 32-bit floats."""
    # 32-bit floats already, unless an image is among them.
    return np.concatenate(list(parts.values()), axis=-1).astype(np.float32, copy=False)
