"""Results of episodes, and their metrics."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from operator import attrgetter
from types import NoneType
from typing import Any, Self, get_args, get_type_hints

import gymnasium as gym

from armscan.envs.rules import Observed
from armscan.errors import InvalidValueError
from armscan.stats.on_plane import ON_PLANE, OnPlane, check_on_plane
from armscan.utils.arrays import FloatArray

# Names of evaluations, after their volumes.
TRAINING, VALIDATION, TEST = "training volumes", "validation volumes", "test volumes"
SUCCESS, DISTANCE = BEST_BY = ("success", "distance")

# Bound on the numbers of an episode, whose sums are then finite.
LARGEST = 1e100

# Means over episodes, by name, and the value of an episode that each averages.
MEANS = {
    "success_rate": "is_success",
    "mean_steps": "n_steps",
    "mean_return": "episode_return",
    "mean_final_reward": "final_reward",
    "mean_best_reward": "best_reward",
    "mean_distance_mm": "distance_mm",
    "mean_distance_deg": "distance_deg",
    "mean_dice": "mean_dice",
}
# Prefixes of metrics that depend on the last plane alone.
OF_LAST_PLANE = ("on_plane_", "mean_distance_", "median_distance_", "mean_dice")

Env = gym.Env[Observed, FloatArray]


def metric_prefix(name: str) -> str:
    """Return the prefix of the tracked metrics of an evaluation, such as `test_volumes`."""
    return name.replace(" ", "_")


TEST_METRICS = metric_prefix(TEST)


@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """Result of an episode.

    Args:
        volume: Name of the volume.
        subject: Subject of the volume. Default: None, the volume is the only one of its subject.
        seed: Seed of the reset.
        n_steps: Number of steps taken.
        is_success: Whether the reward of the last plane is above -success_threshold.
        starts_solved: Whether the reward of the first plane, before any step, is above -success_threshold.
        episode_return: Sum of the rewards.
        final_reward: Reward of the last plane.
        best_reward: Best reward of the chosen planes, without the start.
        distance_mm: Distance of the last plane from the labelled one, in mm.
        distance_deg: Angle between the last plane and the labelled one, in degrees.
        dice_bones: Dice coefficient of the bones on the last slice and on the labelled plane's slice, in [0, 1]; see
            `tissue_dice`.
        dice_tendons: Dice coefficient of the tendons, in [0, 1].
        dice_artery: Dice coefficient of the artery, in [0, 1].
        seconds_per_plane: Mean wall time of choosing a plane and slicing it, in seconds; an equal share for each of
            several episodes side by side. Not compared by `==`.
        nerve_area_error_mm2: Absolute error of the median nerve's area on the last slice against the labelled plane's,
            in mm². Default: None, not measured, or no nerve on the labelled plane's slice.
        nerve_area_error_percent: The same error as a percentage of the area on the labelled plane's slice. Default:
            None, as above.
        expected_mm: Error that the agent predicts for its last plane, in mm. Default: None, it predicts none.
        expected_deg: Error that the agent predicts for its last plane, in degrees. Default: None, it predicts none.
    """

    volume: str
    subject: str | None = None
    seed: int
    n_steps: int
    is_success: bool
    starts_solved: bool
    episode_return: float
    final_reward: float
    best_reward: float
    distance_mm: float
    distance_deg: float
    dice_bones: float
    dice_tendons: float
    dice_artery: float
    seconds_per_plane: float = field(compare=False)
    nerve_area_error_mm2: float | None = None
    nerve_area_error_percent: float | None = None
    expected_mm: float | None = None
    expected_deg: float | None = None

    @property
    def mean_dice(self) -> float:
        """Mean over the three tissues."""
        return statistics.fmean((self.dice_bones, self.dice_tendons, self.dice_artery))


EPISODE_FIELDS = tuple(each.name for each in fields(EpisodeResult))
KINDS = get_type_hints(EpisodeResult)
# Older evaluations lack these fields.
OPTIONAL = {each.name for each in fields(EpisodeResult) if each.default is None}


@dataclass(frozen=True)
class Evaluation:
    """Episodes and their metrics; every mean is over all episodes unless its name says otherwise.

    Args:
        episodes: Episodes of the evaluation.
        on_plane: Limits within which a plane counts as the labelled one, the leading ones first. Default: 5 mm and 10
            degrees, then 2 mm and 5 degrees.
    """

    episodes: tuple[EpisodeResult, ...]
    on_plane: tuple[OnPlane, ...] = ON_PLANE

    @classmethod
    def of_plain(cls, episodes: object, on_plane: object = ON_PLANE) -> Self:
        """Return the evaluation of episodes that were read from JSON, as `to_dict` returned them.

        Args:
            episodes: Episodes as plain values, in a list.
            on_plane: Limits as pairs of mm and degrees. Default: `ON_PLANE`, as for evaluations without limits.

        Raises:
            InvalidValueError: If they are not a list, or one of them is not an episode: a value is missing, unknown, or
                not a number.
        """
        if not isinstance(episodes, list):
            raise InvalidValueError(f"the episodes are a {type(episodes).__name__}, but they must be a list")
        return cls(tuple(_episode_of(each) for each in episodes), check_on_plane("on_plane", on_plane))

    @classmethod
    def pooled(cls, evaluations: Sequence[Self]) -> Self:
        """Return the episodes of one or more evaluations together, with the limits of the first.

        Of several, all volumes count equally: of each, only the first episodes are kept, as many as the least played
        volume has.
        """
        if len(evaluations) == 1:
            return evaluations[0]
        n_played = Counter(episode.volume for each in evaluations for episode in each.episodes)
        n_kept, n_seen = min(n_played.values(), default=0), Counter[str]()
        episodes = []
        for episode in (episode for each in evaluations for episode in each.episodes):
            n_seen[episode.volume] += 1
            if n_seen[episode.volume] <= n_kept:
                episodes.append(episode)
        return cls(tuple(episodes), evaluations[0].on_plane)

    @classmethod
    def of_dict(cls, contents: Mapping[str, Any]) -> Self:
        """Return the evaluation that `to_dict` was called on; see `of_plain`."""
        return cls.of_plain(contents["episodes"], contents.get("on_plane", ON_PLANE))

    @classmethod
    def of_columns(cls, columns: Mapping[str, Sequence[Any]], on_plane: object = ON_PLANE) -> Self:
        """Return the evaluation that `columns` was called on; see `of_plain`."""
        rows = zip(*columns.values(), strict=True)
        return cls.of_plain([dict(zip(columns, row, strict=True)) for row in rows], on_plane)

    def columns(self) -> dict[str, list[Any]]:
        """Return a list of each field over all episodes, by name, which takes less space than the episodes."""
        return {name: [getattr(episode, name) for episode in self.episodes] for name in EPISODE_FIELDS}

    @property
    def on_plane_rate(self) -> float:
        """Share of the episodes that ended within the leading limits of the labelled plane."""
        return self._on_plane_rate(self.on_plane[0])

    @property
    def success_rate(self) -> float:
        """Share of the episodes that ended in success: on a plane whose reward is above -success_threshold."""
        return self._mean("success_rate")

    @property
    def mean_steps(self) -> float:
        """Mean number of steps, episodes without success included."""
        return self._mean("mean_steps")

    def score(self, best_by: str = SUCCESS) -> tuple[float, float]:
        """Return the key that evaluations are compared by, the higher the better.

        Args:
            best_by: Criterion: `success` is the success rate, then the fewest steps; `distance` is the sum of the mean
                distance in mm and the mean angle in degrees, then the success rate.
        """
        if best_by == DISTANCE:
            return -self._mean("mean_distance_mm") - self._mean("mean_distance_deg"), self.success_rate
        return self.success_rate, -self.mean_steps

    def metrics(self) -> dict[str, float]:
        """Return the figures by name; those of episodes that did not start solved stand beside those of all."""
        unsolved = self._of(episode for episode in self.episodes if not episode.starts_solved)
        return {
            **{limits.metric: self._on_plane_rate(limits) for limits in self.on_plane},
            **{f"median_{name}": self._median(name) for name in ("distance_mm", "distance_deg")},
            **{name: self._mean(name) for name in MEANS},
            "episodes": len(self.episodes),
            "episodes_started_solved": len(self.episodes) - len(unsolved.episodes),
            "success_rate_not_started_solved": unsolved.success_rate,
            "mean_steps_not_started_solved": unsolved.mean_steps,
        }

    def by_volume(self) -> dict[str, Evaluation]:
        """Return the episodes of each volume."""
        names = dict.fromkeys(episode.volume for episode in self.episodes)
        return {name: self._of(each for each in self.episodes if each.volume == name) for name in names}

    @property
    def subject_of(self) -> dict[str, str]:
        """Subject of each volume, by name; a volume without one is its own subject."""
        return subject_of_volumes([self])

    def to_dict(self) -> dict[str, Any]:
        """Return the figures and every episode, ready for JSON."""
        limits = [list(each) for each in self.on_plane]
        return {"metrics": self.metrics(), "on_plane": limits, "episodes": list(map(asdict, self.episodes))}

    def _of(self, episodes: Iterable[EpisodeResult]) -> Evaluation:
        return replace(self, episodes=tuple(episodes))

    def _on_plane_rate(self, limits: OnPlane) -> float:
        are_on_plane = [limits.holds(each.distance_mm, each.distance_deg) for each in self.episodes]
        return statistics.fmean(are_on_plane) if are_on_plane else float("nan")

    def _median(self, name: str) -> float:
        return statistics.median(map(attrgetter(name), self.episodes)) if self.episodes else float("nan")

    def _mean(self, name: str) -> float:
        return statistics.fmean(map(attrgetter(MEANS[name]), self.episodes)) if self.episodes else float("nan")


def subject_of_volumes(evaluations: Iterable[Evaluation]) -> dict[str, str]:
    """Return the subject of each volume by name; a volume without one is its own subject."""
    episodes = [episode for evaluation in evaluations for episode in evaluation.episodes]
    own = {episode.volume: episode.volume for episode in episodes}
    # Evaluations of earlier versions do not know subjects.
    return own | {episode.volume: episode.subject for episode in episodes if episode.subject}


def _episode_of(plain: object) -> EpisodeResult:
    if not isinstance(plain, dict) or not KINDS.keys() - OPTIONAL <= plain.keys() <= KINDS.keys():
        raise InvalidValueError(f"an episode is {plain!r}, but it must have {', '.join(KINDS)}, and nothing else")
    for name, value in plain.items():
        if name in OPTIONAL and value is None:
            continue
        kind = next((each for each in get_args(KINDS[name]) if each is not NoneType), KINDS[name])
        # In Python a bool is an int; JSON writes some floats as integers.
        is_of_kind = type(value) is kind or (kind is float and type(value) is int)
        if not is_of_kind or (kind in (int, float) and not -LARGEST < value < LARGEST):
            raise InvalidValueError(f"an episode's {name} is {value!r}, but it must be a finite {kind.__name__}")
    return EpisodeResult(**plain)
