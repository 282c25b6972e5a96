"""Cross-validation: `data.folds` on the command line, or in the experiment that it names, makes a grid of the folds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from armscan.config.compose import compose
from armscan.config.defaults import FOLD, FOLDS, MULTIRUN
from armscan.errors import InvalidValueError, listed
from armscan.launch.grid_jobs import jobs_of

# What may set `data.folds`.
MAY_SET_FOLDS = (f"{FOLDS}=", "experiment=")
# Choices of whole sections, which decide what the data is.
GROUPS = ("experiment", "data")


def with_folds(arguments: Sequence[str]) -> list[str]:
    """Return the arguments of a command line, as a grid over the folds if they ask for folds.

    Other keys that the grid varies, such as `seed=0,1,2`, stay.

    Raises:
        InvalidValueError: If the folds are not allowed or vary, or `data.path` or `data.test` contradicts them.
        ArmscanError: If the folder of the volumes cannot be read.
    """
    overrides = [each for each in arguments if not each.startswith("-")]
    options = [each for each in arguments if each.startswith("-")]
    if set(options) - set(MULTIRUN) or not any(each.lstrip("+").startswith(MAY_SET_FOLDS) for each in overrides):
        return list(arguments)
    try:
        parsed = OverridesParser.create().parse_overrides(overrides)
        data_of_jobs = _data_of_jobs(parsed)
    # Hydra or the run reports it.
    except (HydraException, OmegaConfBaseException):
        return list(arguments)
    if any(each.get("fold") is not None for each in data_of_jobs) or any(each.key_or_group == FOLD for each in parsed):
        return list(arguments)
    if any(each.key_or_group == FOLDS and each.is_sweep_override() for each in parsed):
        raise InvalidValueError(f"{FOLDS} has several values, but all jobs of a grid share one: start a grid for each")
    if all(each.get("folds") is None for each in data_of_jobs):
        return list(arguments)
    folds, path, n_volumes = (_shared(key, data_of_jobs) for key in ("folds", "path", "n_volumes"))
    # Deferred: command-line errors are reported before these are loaded.
    from armscan.training.subject_splits import check_folds, n_folds
    from armscan.volumes.dataset import subjects_in

    if path is None:
        raise InvalidValueError("data.path is not set, but it must be: give data.path=VALUE")
    for each in data_of_jobs:
        check_folds(folds, each.get("test"))
    count = n_folds(folds, len(set(subjects_in(path, n_volumes))))
    return [MULTIRUN[0], *overrides, f"{FOLD}={','.join(map(str, range(count)))}"]


def _shared(key: str, data_of_jobs: Sequence[DictConfig]) -> Any:
    """Return the value of a key of `data` that all jobs share; raise `InvalidValueError` if they do not."""
    values = {each.get(key) for each in data_of_jobs}
    if len(values) > 1:
        raise InvalidValueError(
            f"data.{key} differs between the jobs of this grid ({listed(sorted(map(str, values)))}), but folds are of "
            "the same volumes in all of them: start a grid for each"
        )
    return values.pop()


def _data_of_jobs(parsed: Sequence[Override]) -> list[DictConfig]:
    """Return the section `data` of each combination of experiment and data; other varied overrides are left out."""
    setting = [
        each for each in parsed if each.input_line and (each.key_or_group in GROUPS or not each.is_sweep_override())
    ]
    lines = [str(each.input_line) for each in setting]
    jobs = jobs_of(lines)[1] if any(each.is_sweep_override() for each in setting) else [lines]
    return [compose(job).data for job in jobs]
