"""Network of the plane finder: predicts the labelled plane, and its own error, from several looks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from armscan.agents.finder_parameters import FinderParameters
from armscan.agents.plane_geometry import PlaneGeometry

# Names of the parts of an observation that the network takes.
IMAGE, ACTION = "shares", "action"
# Units of the outputs: two components of the normal, mm along it, mm across.
UNITS = (0.1, 0.05, 3.0, 8.0)
# Units of the places of earlier looks, and the limit that they are clipped to.
PLACE_UNITS, MAX_PLACE = (0.2, 0.2, 10.0, 20.0), 6.0
# Lower bound of expected errors, in mm and degrees: far below real errors, and keeps their logarithm finite.
MIN_EXPECTED = 0.01
# Kernel of each convolution; all have stride 2.
KERNELS = (5, 3, 3)


class PlaneEstimate(NamedTuple):
    """Estimate of the labelled plane, from the latest looks of n episodes.

    Attributes:
        plane: Plane of the latest look, shape (n, 4), in degrees and mm.
        place: Place of the labelled plane in the frame of the latest look, shape (n, 4).
        expected: Expected errors of that place, in mm and degrees, shape (n, 2).
        step: Number of the latest look, one-hot, shape (n, n_looks).
        hidden: Features that the place was computed from, shape (n, n_hidden).
    """

    plane: Tensor
    place: Tensor
    expected: Tensor
    step: Tensor
    hidden: Tensor

    def moved(self, offsets: Tensor) -> PlaneEstimate:
        """Return the estimate with its place moved by `offsets`, in the frame of the latest look."""
        return self._replace(place=self.place + offsets)

    def features(self) -> Tensor:
        """Return all but the plane as one row of numbers for each episode, shape (n, n_features)."""
        return torch.cat([self.hidden, self.place, self.expected, self.step], dim=1)


class LookNetwork(nn.Module):
    """Convolutions over the images of the latest looks, then linear layers that also take the places of these looks.

    One head predicts the place of the labelled plane in the frame of the latest look, as `PlaneGeometry.seen_from`
    defines it. The other predicts the error of that place, in mm and degrees; its gradient does not reach the features.

    Args:
        image_shape: Shape of a look's image: tissues, across, depth.
        finder: Looks and sizes of the network.
    """

    units: Tensor
    places: Tensor

    def __init__(self, image_shape: Sequence[int], finder: FinderParameters) -> None:
        super().__init__()
        n_tissues, *sides = image_shape
        self._n_seen, filters, hidden_sizes = finder.n_seen, finder.filters, finder.hidden_sizes
        channels = pairwise([finder.n_seen * n_tissues, *filters])
        layers = [
            (nn.Conv2d(n_in, n_out, kernel, stride=2, padding=kernel // 2), nn.ReLU())
            for (n_in, n_out), kernel in zip(channels, KERNELS, strict=True)
        ]
        self.convolutions = nn.Sequential(*chain.from_iterable(layers), nn.Flatten())
        for _ in KERNELS:
            sides = [(side + 1) // 2 for side in sides]
        n_features = filters[-1] * sides[0] * sides[1] + 4 * finder.n_seen + finder.n_looks
        sizes = pairwise([n_features, *hidden_sizes])
        self.linear = nn.Sequential(*chain.from_iterable((nn.Linear(*each), nn.ReLU()) for each in sizes))
        self.place = nn.Linear(hidden_sizes[-1], 4)
        # This name is part of checkpoints.
        self.doubt = nn.Sequential(nn.Linear(hidden_sizes[-1], 32), nn.ReLU(), nn.Linear(32, 2))
        self.register_buffer("units", torch.tensor(UNITS))
        self.register_buffer("places", torch.tensor(PLACE_UNITS))

    def earlier_places(self, planes: Tensor, geometry: PlaneGeometry) -> Tensor:
        """Return where the earlier looks that the network sees lie, latest first, shape (n, 4 * (n_seen - 1)).

        Not in `forward`, which may compute in 16 bits.

        Args:
            planes: Planes of the looks, shape (n, n_looks, 4).
            geometry: Free components and bounds of the planes, in degrees and mm.
        """
        if (n_earlier := self._n_seen - 1) == 0:
            return planes[:, 0, :0]
        earlier, latest = planes[:, -n_earlier - 1 : -1].flip(1), planes[:, -1:].expand(-1, n_earlier, -1)
        places = geometry.seen_from(latest.flatten(0, 1), earlier.flatten(0, 1)) / self.places
        return places.clamp(-MAX_PLACE, MAX_PLACE).reshape(-1, 4 * n_earlier)

    def forward(self, images: Tensor, action: Tensor, step: Tensor, earlier: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the place of the labelled plane, its expected errors, both above 0, and the features of both.

        Args:
            images: Looks of an episode, oldest first, bytes of shape (n, n_looks, tissues, across, depth).
            action: Plane of the latest look, normalised, shape (n, 4).
            step: Number of the latest look, one-hot, shape (n, n_looks).
            earlier: Result of `earlier_places`.

        Returns:
            Tensors of shape (n, 4), (n, 2) and (n, hidden_sizes[-1]).
        """
        looks = images[:, -self._n_seen :].flatten(1, 2).float() / 255.0
        seen = self.convolutions(looks.contiguous(memory_format=torch.channels_last))
        hidden = self.linear(torch.cat([seen, action, step, earlier], dim=1))
        expected = nn.functional.softplus(self.doubt(hidden.detach())) + MIN_EXPECTED
        return self.place(hidden) * self.units, expected, hidden


class FinderModule(nn.Module):
    """Network of a plane finder: maps observations of several looks to the next plane.

    The number of the latest look follows from the stack of observations, which is padded with the first one.

    Args:
        network: Network for the looks.
        geometry: Free components and bounds of the planes, in degrees and mm.
        finder: Offsets of the looks, when it stops looking, and how it averages.
        has_stop: Whether actions end with the component `stop`, as with `env.ends=on_stop`.
    """

    offsets: Tensor
    sure: Tensor
    calibration: Tensor

    def __init__(
        self, network: LookNetwork, geometry: PlaneGeometry, finder: FinderParameters, *, has_stop: bool
    ) -> None:
        super().__init__()
        self.network, self.geometry = network, geometry
        self._n_averaged, self._average_tilts, self._has_stop = finder.n_averaged, finder.average_tilts, has_stop
        # No expected error is below -1: then it takes all looks.
        sure = [-1.0 if limit is None else limit for limit in (finder.sure_mm, finder.sure_deg)]
        self.register_buffer("offsets", torch.tensor(finder.offsets_mm, dtype=torch.float32), persistent=False)
        self.register_buffer("sure", torch.tensor(sure, dtype=torch.float32), persistent=False)
        self.register_buffer("calibration", torch.ones(2))

    @property
    def n_features(self) -> int:
        """Number of features of an estimate."""
        return self.network.place.in_features + 4 + 2 + len(self.offsets)

    def estimate(self, observations: dict[str, Tensor]) -> PlaneEstimate:
        """Return the estimate at the latest look, from observations with parts of shape (n, n_looks, ...)."""
        actions = observations[ACTION][:, :, :4]
        n_looks = actions.shape[1]
        is_first = (actions == actions[:, :1]).all(2).float()
        latest = torch.arange(n_looks, device=actions.device)
        # Number of looks up to each one that equal the first; at the leading copies of it, all of them do.
        n_equal = is_first @ (latest[:, None] <= latest).float()
        n_first = (n_equal == latest + 1.0).sum(1)
        step = ((n_looks - n_first)[:, None] == latest).float()
        planes = self.geometry.planes(actions)
        earlier = self.network.earlier_places(planes, self.geometry)
        place, expected, hidden = self.network(observations[IMAGE], actions[:, -1], step, earlier)
        return PlaneEstimate(planes[:, -1], place, expected * self.calibration, step, hidden)

    def found(self, observations: dict[str, Tensor]) -> PlaneEstimate:
        """Return the estimate at the latest look, its place averaged over the latest `n_averaged` estimates."""
        n_averaged = self._n_averaged
        if n_averaged == 1:
            return self.estimate(observations)
        every = self.estimate(self._latest(observations))
        by_look = PlaneEstimate(*(part.reshape(n_averaged, -1, part.shape[1]) for part in every))
        latest = PlaneEstimate(*(part[0] for part in by_look))
        planes = self.geometry.from_frame(every.plane, every.place, torch.zeros_like(every.place[:, 0]))
        places = self.geometry.seen_from(latest.plane.repeat(n_averaged, 1), planes).reshape(n_averaged, -1, 4)
        # Two components are angles, two are in mm.
        weights = by_look.expected[:, :, [1, 1, 0, 0]] ** -2
        place = (weights * places).sum(0) / weights.sum(0)
        if not self._average_tilts:
            place = torch.cat([latest.place[:, :2], place[:, 2:]], dim=1)
        return latest._replace(place=place)

    def _latest(self, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the observations after the latest look, the one before it, and so on, shape (n_averaged * n, ...).

        Before the first look, the first is repeated.
        """
        looks = [{name: observations[name] for name in (IMAGE, ACTION)}]
        for _ in range(1, self._n_averaged):
            looks.append({name: torch.cat([part[:, :1], part[:, :-1]], dim=1) for name, part in looks[-1].items()})
        return {name: torch.cat([each[name] for each in looks]) for name in (IMAGE, ACTION)}

    def is_sure(self, expected: Tensor) -> Tensor:
        """Return whether the agent stops at planes with these expected errors, shape (..., 2), before its last look."""
        return (expected <= self.sure).all(-1)

    def actions(self, estimate: PlaneEstimate) -> Tensor:
        """Return the next actions, shape (n, n_action)."""
        beside_mm = estimate.step @ self.offsets
        is_last = (estimate.step[:, -1] > 0.0) | self.is_sure(estimate.expected)
        beside_mm = beside_mm.masked_fill(is_last, 0.0)
        actions = self.geometry.actions(self.geometry.from_frame(estimate.plane, estimate.place, beside_mm))
        if self._has_stop:
            actions = torch.cat([actions, 2.0 * is_last[:, None] - 1.0], dim=1)
        return actions

    def forward(self, observations: dict[str, Tensor]) -> tuple[tuple[Tensor, Tensor], None]:
        """Return the next actions, shape (n, n_action), and the expected errors of the planes found so far, (n, 2)."""
        estimate = self.found(observations)
        return (self.actions(estimate), estimate.expected), None


def looks_of(observations: Any, device: torch.device | str) -> dict[str, Tensor]:
    """Return the parts of observations that a plane finder takes, as tensors."""
    return {name: torch.as_tensor(observations[name], device=device) for name in (IMAGE, ACTION)}
