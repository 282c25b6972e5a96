"""Candidates of a final evaluation: the numbers of trials, and the control.

Each candidate is trained with several seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from optuna.trial import FrozenTrial, Trial

from armscan.config.legacy import renamed
from armscan.sweeps.scheduling.population import searched_values
from armscan.sweeps.scheduling.state import CONTROL
from armscan.sweeps.storage.attribute_names import FINAL_SEED, FINALIST, SCHEDULE

# Description of the control.
NOTHING_SEARCHED = "the study's configuration without the searched values"


def training_of(trial: FrozenTrial | Trial) -> tuple[int, int]:
    """Return the configuration and the seed of a final training."""
    return int(trial.user_attrs[FINALIST]), int(trial.user_attrs[FINAL_SEED])


def name_of(number: int) -> str:
    """Return the name of a configuration for users: `control`, or `trial 7`."""
    return "control" if number == CONTROL else f"trial {number}"


def key_of(number: int) -> int | str:
    """Return the name of a configuration in files: the number of its trial, or `control`."""
    return "control" if number == CONTROL else number


def settings_of(searched: Sequence[FrozenTrial], number: int) -> dict[str, Any]:
    """Return the values of a configuration by their keys; the control has none.

    Args:
        searched: Trials of the search.
        number: Number of one of them, or `CONTROL`.
    """
    return {} if number == CONTROL else renamed(searched_values(searched[number]))


def attributes_of(searched: Sequence[FrozenTrial], number: int, seed: int) -> dict[str, Any]:
    """Return the user attributes of a final training; see `training_of`.

    Args:
        searched: Trials of the search.
        number: Number of one of them, or `CONTROL`.
        seed: Seed of the training.
    """
    schedule = [] if number == CONTROL else searched[number].user_attrs.get(SCHEDULE, [])
    return {FINALIST: number, FINAL_SEED: seed} | ({SCHEDULE: schedule} if schedule else {})
