"""A trial without training: how well a clustering distinguishes the labelled planes from the rest of the arm."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import fmean

import numpy as np
from hydra.utils import instantiate
from omegaconf import DictConfig

from armscan.anatomy import PUBLISHED_TARGETS, PlaneScorer, fitted_reward
from armscan.anatomy.tissues import Tissues, check_tissues
from armscan.errors import InvalidValueError
from armscan.experiment.build import check_keys
from armscan.sweeps.scheduling.state import TEST_PREFIX
from armscan.sweeps.tasks.attempt import Attempt, volumes_of
from armscan.volumes.plane import ManipulatorAction

METRICS = ("separation", "labelled_reward", "elsewhere_reward", "worst_labelled_reward")
# Planes nearer to the labelled one than this are neither right nor wrong; the others are sampled in these steps.
NEAR_MM, STEP_MM = 15.0, 2.5


class LandmarksTask:
    """The task of clustering: compare rewards at the labelled planes with those at planes along the rest of the arm.

    The space has keys of `env.clustering`, which the configuration must write in full.
    """

    def metrics(self, config: DictConfig) -> tuple[str, ...]:
        """Return the names of the metrics: difference of both mean rewards, both means, worst labelled reward."""
        return METRICS

    @property
    def final_metric(self) -> str:
        """Name of the difference on the test volumes."""
        return f"{TEST_PREFIX}separation"

    def check(self, config: DictConfig) -> None:
        """See `Task.check`."""
        check_keys(config)
        if not isinstance(config.env.clustering, DictConfig):
            raise InvalidValueError(
                f"env.clustering is {config.env.clustering!r}, but this study searches its parts: write it in full"
            )
        self._tissues(config)
        volumes_of(config)

    def run(self, attempt: Attempt) -> dict[str, float]:
        """Return the metrics on the training volumes. See `Task.run`."""
        return self._measured(attempt, "training")

    def validate(self, attempt: Attempt) -> dict[str, float]:
        """Return the metrics on the validation volumes. See `Task.validate`."""
        return self._measured(attempt, "validation")

    def evaluate(self, attempt: Attempt) -> dict[str, float]:
        """Return the metrics on the test volumes, all and each. See `Task.evaluate`."""
        rewards = self._rewards(attempt, "test")
        volumes = volumes_of(attempt.config(attempt.seeds[0])[0]).test
        attempt.keep_subjects({name: volume.subject or name for name, volume in volumes.items()})
        metrics = {f"{TEST_PREFIX}{name}": value for name, value in _metrics_of(rewards).items()}
        for volume, pair in rewards.items():
            of_volume = _metrics_of({volume: pair})
            # The worst of all is no mean over the volumes.
            metrics |= {f"{TEST_PREFIX}volume/{volume}/{name}": of_volume[name] for name in METRICS[:-1]}
        return metrics

    def _measured(self, attempt: Attempt, part: str) -> dict[str, float]:
        """Return the metrics on a part of the volumes."""
        return _metrics_of(self._rewards(attempt, part))

    def _rewards(self, attempt: Attempt, part: str) -> dict[str, tuple[float, float]]:
        """Return each volume's reward at the labelled plane and its mean elsewhere; training volumes fit it."""
        config, _ = attempt.config(attempt.seeds[0])
        tissues, volumes = self._tissues(config), volumes_of(config).parts
        given = instantiate(config.reward, _convert_="object")
        reward = fitted_reward(given, PUBLISHED_TARGETS, volumes["training"].values(), tissues)
        rewards = {}
        for name, volume in volumes[part].items():
            scorer, labelled = PlaneScorer(volume, reward, tissues), volume.optimal_action
            if labelled is None:
                raise InvalidValueError(f"{volume.name}: has no labelled plane, which clusterings are compared by")
            tx_mm, ty_mm = labelled.translation
            places = np.arange(0.0, volume.size_mm[1], STEP_MM)
            far = [place for place in places if abs(place - ty_mm) > NEAR_MM]
            planes = [ManipulatorAction(labelled.rotation, (tx_mm, float(place))) for place in far]
            rewards[name] = scorer.score(labelled)[0], fmean(scorer.score(plane)[0] for plane in planes)
        return rewards

    def _tissues(self, config: DictConfig) -> Tissues:
        return check_tissues(instantiate(config.env.clustering, _convert_="object"))


def _metrics_of(rewards: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    at_plane, elsewhere = zip(*rewards.values(), strict=True)
    right, wrong = fmean(at_plane), fmean(elsewhere)
    return dict(zip(METRICS, (right - wrong, right, wrong, min(at_plane)), strict=True))
