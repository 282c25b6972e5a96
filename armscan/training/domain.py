"""Training domain of an agent: shapes of observations, sizes of pixels and volumes."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

from gymnasium import spaces
from pydantic import TypeAdapter, ValidationError

from armscan.envs.observation_registry import NAMED_OBSERVATIONS
from armscan.envs.observations import smallest_shape
from armscan.errors import InvalidValueError
from armscan.training.episode_results import Env
from armscan.volumes import LabelVolume

# Share by which a size may lie outside the range of the training volumes without a note.
USUAL_DIFFERENCE = 0.1
MAX_SHOWN_CHARS = 100
# Observations that are the same for every size of pixels.
IN_MM = ("ActionRewardObservation", "MetricSliceObservation")
Range = tuple[float, float]


@dataclass(frozen=True)
class TrainingDomain:
    """Shapes of observations on some volumes, and the range of the volumes' sizes.

    Args:
        observed: Shape of each part of an observation; a single vector has the name `vector`.
        slice_px: Largest shape (across, depth) in pixels that fits into all slices; images are cropped to it.
        pixel_mm: Smallest and largest pixel size, (across, depth) in mm.
        size_mm: Smallest and largest size of a volume, (across, along) in mm, which is the range of a normalised
            translation.
    """

    observed: dict[str, tuple[int, ...]]
    slice_px: tuple[int, int]
    pixel_mm: tuple[Range, Range]
    size_mm: tuple[Range, Range]

    @classmethod
    def of(cls, env: Env, slice_px: tuple[int, int] | None = None) -> Self:
        """Return the domain of an environment.

        Args:
            env: Environment with the volumes.
            slice_px: Crop of its images if the configuration gives none. Default: the largest that fits into all
                slices.
        """
        space, volumes = env.observation_space, env.get_wrapper_attr("volumes").values()
        parts = space.spaces if isinstance(space, spaces.Dict) else {"vector": space}
        return cls(
            observed={name: tuple(part.shape or ()) for name, part in parts.items()},
            slice_px=slice_px or smallest_slice(volumes),
            pixel_mm=(_range(v.pixel_mm[0] for v in volumes), _range(v.pixel_mm[1] for v in volumes)),
            size_mm=(_range(v.size_mm[0] for v in volumes), _range(v.size_mm[1] for v in volumes)),
        )

    def to_json(self) -> str:
        """Return it as a string that `from_json` reads."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read the JSON of `to_json`.

        Raises:
            InvalidValueError: If it is anything else.
        """
        try:
            return TypeAdapter(cls).validate_json(text)
        except ValidationError as error:
            raise InvalidValueError(f"no training domain can be read from {text[:MAX_SHOWN_CHARS]!r}") from error

    def check_observed(self, other: TrainingDomain) -> None:
        """Raise `InvalidValueError` if observations of other environments have another shape than these."""
        for name in self.observed.keys() | other.observed.keys():
            here, there = self.observed.get(name), other.observed.get(name)
            if here != there:
                raise InvalidValueError(
                    f"the agent takes observations whose part {name!r} has the shape {here}, but on these "
                    f"volumes it has {there}: it cannot be applied to them; obs.shape=[ACROSS,DEPTH] at training gives "
                    "images of one shape, and obs=cluster none"
                )

    def differences(self, other: TrainingDomain, observation: Any, *, is_bounded: bool) -> list[str]:
        """Return the differences that an agent meets on other volumes, one sentence each.

        Args:
            other: Domain of the other volumes.
            observation: Configuration of its observation, as plain dictionaries and lists, or a name.
            is_bounded: Whether the configuration bounds translations, which are then the same in mm everywhere.
        """
        parts = [*_parts(_spelled_out(observation))]
        compared: list[tuple[str, Sequence[Range], Sequence[Range], str, str, str]] = []
        if any(map(_is_in_pixels, parts)):
            means = "what the agent sees in pixels has another scale"
            compared.append(("a pixel", self.pixel_mm, other.pixel_mm, "in depth", "mm", means))
        if any(part.get("crop", 0) is None and part.get("shape") is not None for part in parts):
            cropped = [(min(here, trained),) * 2 for here, trained in zip(other.slice_px, self.slice_px, strict=True)]
            trained = [(px, px) for px in self.slice_px]
            compared.append(("an image", trained, cropped, "in depth", "pixels", "it is stretched to the same shape"))
        if not is_bounded:
            means = "the same normalised translation is another distance in mm"
            compared.append(("a volume", self.size_mm, other.size_mm, "along the arm", "mm", means))
        notes = []
        for what, here, there, axis, unit, means in compared:
            unusual = [
                f"{_shown(seen)} {unit} {axis} (trained on {_shown(known)})"
                for axis, known, seen in zip(("across", axis), here, there, strict=True)
                if seen[0] < known[0] * (1 - USUAL_DIFFERENCE) or seen[1] > known[1] * (1 + USUAL_DIFFERENCE)
            ]
            if unusual:
                notes.append(f"{what} is {' and '.join(unusual)}: {means}")
        return notes


def smallest_slice(volumes: Iterable[LabelVolume]) -> tuple[int, int]:
    """Return the largest shape that fits into the slices of all volumes, (across, depth) in pixels."""
    return smallest_shape([volume.slice_shape for volume in volumes])


def with_crops(rules: Any, trained: tuple[int, int], here: tuple[int, int]) -> Any:
    """Return the configuration of an observation with images cropped as in an agent's training.

    Without a crop in the configuration, images are cropped to the largest shape that fits into the slices of the
    environment's volumes, which differs between data sets. Images that are resized to one shape are cropped, along
    each axis, to the smaller of both.

    Args:
        rules: Configuration as plain dictionaries and lists, or the name of an observation.
        trained: Largest shape that fits into the slices of the training volumes, (across, depth) in pixels.
        here: The same of the volumes that the agent is applied to.

    Raises:
        InvalidValueError: If images would have to be larger than the slices.
    """
    return _cropped(_spelled_out(rules), trained, here)


def _spelled_out(rules: Any) -> Any:
    """Return the configuration of an observation with the names of image observations written out in full."""
    named = NAMED_OBSERVATIONS.get(rules) if isinstance(rules, str) else None
    if named and "crop" in inspect.signature(named).parameters:
        return {"_target_": f"armscan.envs.{named.__name__}", "crop": None, "shape": None}
    if isinstance(rules, list):
        return [_spelled_out(each) for each in rules]
    if isinstance(rules, dict) and "observations" in rules:
        return rules | {"observations": _spelled_out(rules["observations"])}
    return rules


def _parts(rules: Any) -> Iterator[dict[str, Any]]:
    """Yield the configuration of each single observation that is written out."""
    if isinstance(rules, list):
        for each in rules:
            yield from _parts(each)
    elif isinstance(rules, dict):
        yield from _parts(rules["observations"]) if "observations" in rules else [rules]


def _is_in_pixels(part: Mapping[str, Any]) -> bool:
    """Return whether an observation depends on the size of pixels; a class of the user's own may."""
    name = str(part.get("_target_")).rpartition(".")[2]
    return name not in IN_MM and not (name == "ClusterObservation" and part.get("normalised", True))


def _cropped(rules: Any, trained: tuple[int, int], here: tuple[int, int]) -> Any:
    if isinstance(rules, list):
        return [_cropped(each, trained, here) for each in rules]
    if not isinstance(rules, dict):
        return rules
    changed = {name: _cropped(each, trained, here) for name, each in rules.items()}
    if not {"crop", "shape"} <= rules.keys() or rules["crop"] is not None:
        return changed
    if rules["shape"] is None and (here[0] < trained[0] or here[1] < trained[1]):
        raise InvalidValueError(
            f"the agent was trained on images of {trained[0]} x {trained[1]} pixels (across, depth), but slices of "
            f"these volumes have {here[0]} x {here[1]}: it cannot be applied to them; an agent trained with "
            "obs.shape=[ACROSS,DEPTH] takes slices of every size"
        )
    return changed | {"crop": [min(each) for each in zip(trained, here, strict=True)]}


def _range(values: Iterable[float]) -> Range:
    known = list(values)
    return min(known), max(known)


def _shown(span: Range) -> str:
    low, high = (f"{end:.3g}" for end in span)
    return low if low == high else f"{low} to {high}"
