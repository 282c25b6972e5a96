"""Jobs of a grid, before it runs: print them, and check their overrides."""

from __future__ import annotations

from collections.abc import Sequence

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from armscan.config.compose import compose, config_loader
from armscan.config.defaults import MULTIRUN, PLAN
from armscan.config.sources import SWEEP
from armscan.errors import ArmscanError, InvalidValueError
from armscan.launch.folds_grid import with_folds

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
    if len(jobs) == 1:
        raise InvalidValueError(
            f"{PLAN} is given, but this is a single run: it shows the jobs of a grid, and what a study searches "
            f"({SWEEP}=NAME)"
        )
    fixed = {each.input_line for each in parsed if not each.is_sweep_override()}
    print(f"a grid of {len(jobs)} jobs")
    for number, job in enumerate(jobs):
        # Raises the error that the job would.
        compose(job)
        print(f"{number:4d}  {' '.join(each for each in job if each not in fixed)}")


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
    from armscan.experiment.build import check_config, check_effects

    errors = []
    _, jobs = jobs_of(overrides)
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


def jobs_of(overrides: Sequence[str]) -> tuple[list[Override], list[list[str]]]:
    """Return the overrides of a grid, parsed, and those of each job."""
    # Of `glob(...)`, the loader tells which choices there are.
    with config_loader() as loader:
        parsed = OverridesParser.create(config_loader=loader).parse_overrides(list(overrides))
        (jobs,) = BasicSweeper.split_arguments(parsed, max_batch_size=None)
    return parsed, jobs
