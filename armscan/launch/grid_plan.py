"""Plan of a grid, without running it: its jobs, and what each of them varies."""

from __future__ import annotations

from collections.abc import Sequence

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser

from armscan.config.compose import compose
from armscan.config.defaults import MULTIRUN, PLAN
from armscan.config.sources import SWEEP
from armscan.errors import InvalidValueError
from armscan.launch.folds_grid import with_folds


def print_grid_plan(words: Sequence[str]) -> None:
    """Print the jobs that a command line would run, folds of a cross-validation included.

    Args:
        words: Words of the command line.

    Raises:
        InvalidValueError: If they are of a single run.
        HydraException: If a job cannot be composed.
    """
    overrides = [word for word in with_folds([word for word in words if word != PLAN]) if word not in MULTIRUN]
    parsed = OverridesParser.create().parse_overrides(overrides)
    (jobs,) = BasicSweeper.split_arguments(parsed, max_batch_size=None)
    if len(jobs) == 1:
        raise InvalidValueError(
            f"{PLAN} is given, but this is a single run: it shows the jobs of a grid, and what a study searches "
            f"({SWEEP}=NAME)"
        )
    varied = {each.input_line for each in parsed if not each.is_sweep_override()}
    print(f"a grid of {len(jobs)} jobs")
    for number, job in enumerate(jobs):
        # Raises what the job would.
        compose(job)
        print(f"{number:4d}  {' '.join(word for word in job if word not in varied)}")
