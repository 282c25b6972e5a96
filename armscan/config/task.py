"""Keys of a configuration that make up the task of an episode, and the volumes that an agent is tested on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import chain

RULES = ("projection", "reward", "env")
# What an agent sees of an episode: the task stays the same.
SEEN = ("env.observation", "env.stack", "env.stack_exclude", "env.stack_memory", "env.memory", "env.flat")
# Rules on where episodes begin and what an agent can move: no metric compares across these.
PLACES = ("projection", "env.projection", "env.transform", "env.start")
# Deformations of the training volumes alone.
OF_TRAINING = tuple(f"env.transform.{name}" for name in ("scale", "stretch", "shear", "mirror"))
# Keys of the data that leave the test volumes as they are.
NOT_TESTED_ON = ("data.cache_dir", "data.first_seed", "data.n_training", "data.n_validation")


def is_under(key: str, sections: Iterable[str]) -> bool:
    """Return whether a dotted key is one of some keys, or in one of these sections."""
    return any(key == each or key.startswith(f"{each}.") for each in sections)


def rules_in(params: Mapping[str, str]) -> dict[str, str]:
    """Return the parameters that make up the task of an episode, or how it is judged."""
    return {
        key: value for key, value in params.items() if is_under(key, RULES) and not is_under(key, (*SEEN, *OF_TRAINING))
    }


def task_differences(params: Iterable[Mapping[str, str]]) -> list[str]:
    """Return the parameters by which tasks or test volumes of runs differ, as far as they have stored any."""
    tasks = [
        rules_in(each)
        | {key: value for key, value in each.items() if is_under(key, ("data",)) and key not in NOT_TESTED_ON}
        for each in params
        if each
    ]
    return [key for key in dict.fromkeys(chain(*tasks)) if len({task.get(key) for task in tasks}) > 1]


def have_same_task(params: Iterable[Mapping[str, str]]) -> bool:
    """Return whether all runs have the same task and test volumes, as far as they have stored their parameters."""
    return not task_differences(params)
