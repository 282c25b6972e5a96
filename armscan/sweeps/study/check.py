"""Whether every value of a search space is one that a run can be built with, before anything is trained."""

from __future__ import annotations

from collections.abc import Sequence

from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from armscan.config.error_messages import one_line_message
from armscan.errors import ArmscanError, InvalidValueError
from armscan.sweeps.space.overrides import overrides_of
from armscan.sweeps.study.settings import StudySettings
from armscan.sweeps.tasks.attempt import composed
from armscan.sweeps.tasks.base import Task


def check_space(settings: StudySettings, task: Task, words: Sequence[str], config: DictConfig) -> None:
    """Build what is run as it is without the space, then with each choice and both ends of each range.

    Choices of groups and of keys at the top are tried beside values of all others, too, as a trial has them.

    Args:
        settings: of the study.
        task: what its trials do.
        words: of the command line.
        config: that they are composed to.

    Raises:
        InvalidValueError: if a key is unknown, or a value not allowed.
    """
    task.check(config)
    tried = list(settings.space.extremes())
    # What one of them changes, the last, may leave no place for another.
    tried += [settings.space.completed(chosen) for chosen in tried if "." not in list(chosen)[-1]]
    for chosen in tried:
        overrides = overrides_of(chosen)
        try:
            with_it, _ = composed([*words, *overrides])
            task.check(with_it)
        except (ArmscanError, HydraException, OmegaConfBaseException, ValueError) as error:
            line = one_line_message(error) or str(error)
            raise InvalidValueError(f"study.space: {' '.join(overrides)} is not allowed: {line}") from error
