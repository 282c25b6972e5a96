"""Keys of a configuration that make up the task of an episode, and the volumes that an agent is tested on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

RULES = ("projection", "reward", "env")
# What an agent sees of an episode: the task stays the same.
SEEN = ("env.observation", "env.stack", "env.stack_exclude", "env.stack_memory", "env.memory", "env.flat")
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


def have_same_task(params: Iterable[Mapping[str, str]]) -> bool:
    """Return whether all runs have the same task and test volumes, as far as they have stored their parameters."""
    tasks = [
        rules_in(each)
        | {key: value for key, value in each.items() if is_under(key, ("data",)) and key not in NOT_TESTED_ON}
        for each in params
        if each
    ]
    return all(task == tasks[0] for task in tasks)
