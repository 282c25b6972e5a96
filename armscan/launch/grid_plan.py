"""Jobs of a grid, before it runs: print them, and check their overrides."""

from __future__ import annotations

from collections.abc import Sequence

from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from armscan.config.compose import compose
from armscan.config.defaults import MULTIRUN, PLAN
from armscan.config.error_messages import one_line_message
from armscan.config.sources import SWEEP
from armscan.errors import ArmscanError, InvalidValueError
from armscan.launch.folds_grid import GROUPS, with_folds
from armscan.launch.grid_jobs import jobs_of, shared_overrides

# With these arguments, only Hydra knows the jobs.
NOT_CHECKED = ("-", "hydra/sweeper", "hydra.sweeper")


def print_grid_plan(arguments: Sequence[str]) -> None:
    """Print the jobs that a command line would run, folds of a cross-validation included.

    Args:
        arguments: Arguments of the command line.

    Raises:
        InvalidValueError: If they describe a single run.
        HydraException: If a job cannot be composed.
    """
    with_its_folds = with_folds([each for each in arguments if each != PLAN])
    overrides = [each for each in with_its_folds if each not in MULTIRUN]
    parsed, jobs = jobs_of(overrides)
    if len(overrides) == len(with_its_folds):
        # The run without the option raises the same error.
        compose(overrides)
    if len(jobs) == 1:
        raise InvalidValueError(
            f"{PLAN} is given, but this is a single run: it shows the jobs of a grid, and what a study searches "
            f"({SWEEP}=NAME)"
        )
    _check_shared(parsed)
    shared = shared_overrides(parsed)
    print(f"a grid of {len(jobs)} jobs")
    for number, job in enumerate(jobs):
        # Raises the error that the job would.
        compose(job)
        print(f"{number:4d}  {' '.join(each for each in job if each not in shared)}")


def check_grid(arguments: Sequence[str]) -> None:
    """Raise the error of the first job if all jobs of a grid have wrong overrides; otherwise the correct ones run.

    Args:
        arguments: Arguments of the command line; a single run, and a sweeper other than Hydra's basic one, are left to
            Hydra.
    """
    overrides = [each for each in arguments if each not in MULTIRUN]
    if len(overrides) == len(arguments) or any(each.startswith(NOT_CHECKED) for each in overrides):
        return
    print("preparing a grid: checking its overrides", flush=True)
    # Deferred: it takes time, so the line above comes first.
    from armscan.experiment.build import check_config
    from armscan.experiment.effects import check_effects

    errors = []
    parsed, jobs = jobs_of(overrides)
    _check_shared(parsed)
    for job in jobs:
        config = compose(job)
        try:
            check_config(config)
            check_effects(config, job)
        except (ArmscanError, HydraException, OmegaConfBaseException) as error:
            errors.append(error)
        else:
            return
    raise errors[0]


def _check_shared(parsed: Sequence[Override]) -> None:
    """Raise an error if Hydra cannot compose the overrides that all jobs share, which it does first."""
    try:
        compose([str(each.input_line) for each in parsed if not each.is_sweep_override()])
    except (HydraException, OmegaConfBaseException) as error:
        varied = [each.key_or_group for each in parsed if each.is_sweep_override() and each.key_or_group in GROUPS]
        if not varied:
            raise
        raise InvalidValueError(
            f"{one_line_message(error)}; Hydra first composes the grid without {varied[0]}, because it has several "
            "values: add what the other overrides need, such as data=mixed"
        ) from error
