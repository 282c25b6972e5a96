"""Checks that the trials of a study, which are compared with each other, have the same task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from omegaconf import DictConfig, OmegaConf

from armscan.config.defaults import to_plain
from armscan.config.task import PLACES, is_under, rules_in
from armscan.envs.rules import ON_STOP
from armscan.errors import InvalidValueError, few, listed
from armscan.sweeps.study.fixed_config import differing
from armscan.sweeps.tasks.attempt import volumes_of
from armscan.tracking import flatten
from armscan.training import PARTS
from armscan.training.episode_results import OF_LAST_PLANE
from armscan.training.metric_display import is_rate

# Prefixes of objectives that do not depend on how an episode is rewarded, and when it ends.
WITHOUT_RULES = (*OF_LAST_PLANE, "training_s", "env_steps")
# Metrics, beside rates, of which the highest is the best; of all others it is the lowest.
HIGHER_IS_BETTER = ("mean_return", "mean_final_reward", "mean_best_reward", "mean_dice", "solved")
MAXIMIZE, MINIMIZE = "maximize", "minimize"


def check_objectives(objectives: Mapping[str, str], config: DictConfig) -> None:
    """Check that the best trial is a good one.

    Args:
        objectives: Direction of each objective, by its name.
        config: Configuration of the trials.

    Raises:
        InvalidValueError: If a direction is the wrong one, or an agent that stops at once would be the best.
    """
    for name, direction in objectives.items():
        better = MAXIMIZE if is_rate(name) or name.startswith(HIGHER_IS_BETTER) else MINIMIZE
        if direction != better:
            raise InvalidValueError(f"study.objectives has '{direction} {name}', but it must be '{better} {name}'")
    if OmegaConf.select(config, "env.ends") == ON_STOP and all(name.startswith("mean_steps") for name in objectives):
        raise InvalidValueError(
            f"study.objectives is {listed(objectives)}, but env.ends is {ON_STOP}: the best agent would stop at once; "
            "give study.objectives=['maximize on_plane_5mm_10deg']"
        )


def check_same_task(objectives: Sequence[str], control: DictConfig, other: DictConfig) -> None:
    """Raise an error unless the trials of two configurations compare.

    Validation and test volumes must be the same. Rules may differ only if no objective depends on them.

    Args:
        objectives: Names of the objectives.
        control: Configuration without the searched values.
        other: Configuration with some of them.

    Raises:
        InvalidValueError: If their trials would not compare.
    """
    if control.data != other.data:
        before, now = (volumes_of(each).fingerprints() for each in (control, other))
        if parts := [part for part in PARTS[1:] if before[part] != now[part]]:
            raise InvalidValueError(
                f"the {' and '.join(parts)} volumes are not the control's, so results would not compare"
            )
    rules = differing(*(rules_in(flatten(to_plain(each))) for each in (control, other)))
    by_rules = [name for name in objectives if not name.startswith(WITHOUT_RULES)]
    if changed := [key for key in rules if by_rules or is_under(key, PLACES)]:
        what = by_rules[0] if by_rules else objectives[0]
        raise InvalidValueError(
            f"it is another task than the control's ({few(changed, 2)}), so {what} would not compare: try the values "
            "in a grid, armscan run -m KEY=A,B"
        )
