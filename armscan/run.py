"""The command `armscan run`: one run, several with -m, an interrupted one with resume=ID."""

from __future__ import annotations

import os

from armscan.utils.processes import (
    EXIT_INTERRUPTED,
    collect_garbage_rarely,
    discard_output,
    end_like_ctrl_c,
    limit_threads,
    no_garbage_collection,
)

limit_threads()
collect_garbage_rarely()
# Ray reads this when it is imported, and other libraries import Ray if it is installed. Without it, Ray aborts a study
# that is asked to end, and prints a stack trace.
os.environ.setdefault("RAY_DISABLE_FAILURE_SIGNAL_HANDLER", "1")

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from armscan.config.compose import application
from armscan.config.credentials import check_overrides
from armscan.config.defaults import MULTIRUN, PLAN, RESUME
from armscan.config.error_messages import TRACEBACKS, one_line_message, print_mistake
from armscan.config.sources import SWEEP
from armscan.errors import is_interruption
from armscan.experiment.job import INTERRUPTED, Invocation, check_choices, check_folder_stays, remove_if_untracked
from armscan.launch.folds_grid import with_folds
from armscan.launch.grid_plan import check_grid, print_grid_plan
from armscan.launch.job_process import start_job
from armscan.launch.launchers import ON_THIS_MACHINE, launcher_error
from armscan.launch.multirun import Multirun, end_grid, print_resume_command
from armscan.utils.log import silence_libraries

if TYPE_CHECKING:
    from armscan.launch.resume import GridToRepeat


def run(config: DictConfig) -> None:
    """Run a configuration composed by Hydra: a single run, a job of a grid, or a worker of a study."""
    if config.get("study") is not None:
        # Deferred, because only studies need Optuna.
        from armscan.sweeps.study.arguments import trial_overrides
        from armscan.sweeps.workers.supervisor import run_worker

        hydra_config = HydraConfig.get()
        overrides = trial_overrides([*hydra_config.overrides.task, *hydra_config.overrides.hydra])
        run_worker(overrides, int(config.study.worker), Path(hydra_config.sweep.dir))
        return
    invocation = Invocation.current()
    if invocation.job is not None:
        start_job(config, invocation, invocation.job)
        return
    made = "" if invocation.choices["data"] == "nifti" else " (phantoms are made when first asked for, four a second)"
    print(f"preparing data={invocation.choices['data']}, agent={invocation.choices['agent']}{made}", flush=True)
    try:
        # Deferred: a mistake on the command line should be reported before torch is loaded.
        with no_garbage_collection():
            from armscan.experiment.runner import run_experiment

        run_experiment(config, invocation)
    except KeyboardInterrupt as error:
        remove_if_untracked(invocation.folder, error)
        raise
    # Reported here: if it reached Hydra, Hydra would print messages of its own.
    except Exception as error:
        remove_if_untracked(invocation.folder, error)
        if is_interruption(error):
            raise KeyboardInterrupt from error
        raise_or_exit(error)


def raise_or_exit(error: BaseException) -> NoReturn:
    """Report a user's mistake in one line and exit; raise any other error, or every error if tracebacks are wanted."""
    if not print_mistake(error):
        raise error
    raise SystemExit(2)


def launch(arguments: Sequence[str]) -> None:
    """Run the command through Hydra with these arguments."""
    sys.argv[1:] = arguments
    try:
        application(run)()
    except Exception as error:
        launcher = Multirun.launcher
        # Only for grids: studies report their launcher's errors themselves.
        if launcher is None or launcher in ON_THIS_MACHINE or is_interruption(error) or one_line_message(error):
            raise
        raise launcher_error(launcher, error) from error


def repeat_grid(grid: GridToRepeat) -> None:
    """Run the jobs of a grid that have not finished."""
    Multirun.repeats, Multirun.is_trusted = grid.run_id, grid.trust
    launch([MULTIRUN[0], *grid.overrides])


def _end_grid(*, is_interrupted: bool) -> int:
    """Close a grid, and return the exit code; after an interrupt or an error meanwhile, resuming the grid does it."""
    try:
        return end_grid(is_interrupted=is_interrupted)
    except (KeyboardInterrupt, Exception) as error:
        print_resume_command()
        if not is_interruption(error):
            raise_or_exit(error)
        return EXIT_INTERRUPTED


def main() -> int:
    """Run the command line; return the exit code."""
    if os.environ.get("HYDRA_FULL_ERROR") == "1":
        os.environ[TRACEBACKS] = "1"
    # Makes Hydra raise its errors, so that they are reported here.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # The run is closed as KILLED in the tracking store.
    end_like_ctrl_c()
    silence_libraries()
    # Hydra reads its options only before the first override, but users type them anywhere.
    sys.argv[1:] = sorted(sys.argv[1:], key=lambda each: each not in MULTIRUN)
    try:
        check_overrides(sys.argv[1:])
        check_folder_stays(sys.argv[1:])
        check_choices(sys.argv[1:])
        if any(each.startswith(f"{SWEEP}=") for each in sys.argv[1:]):
            if PLAN not in sys.argv[1:]:
                print("preparing a study: its space is checked first", flush=True)
            # Deferred until after the first line; invalid overrides are reported before Optuna is loaded.
            from armscan.sweeps.study.arguments import check_training_overrides

            check_training_overrides(sys.argv[1:])
            from armscan.sweeps.command import run_study

            return run_study(sys.argv[1:], launch)
        if PLAN in sys.argv[1:]:
            print_grid_plan(sys.argv[1:])
            return 0
        if any(each.startswith(f"{RESUME}=") for each in sys.argv[1:]):
            # Before Hydra composes a configuration and creates a folder: a resumed run has both.
            from armscan.launch.resume import resume

            if grid := resume(sys.argv[1:]):
                repeat_grid(grid)
        else:
            arguments = with_folds(sys.argv[1:])
            check_grid(arguments)
            launch(arguments)
    except BrokenPipeError:
        discard_output()
        return 1
    except (KeyboardInterrupt, Exception) as error:
        # An interrupt inside compiled code can surface as any other error.
        if not is_interruption(error):
            _end_grid(is_interrupted=False)
            raise_or_exit(error)
    else:
        return _end_grid(is_interrupted=False)
    # Not in the handler, where every further error would seem to follow from the interruption.
    _end_grid(is_interrupted=True)
    print(INTERRUPTED, file=sys.stderr)
    return EXIT_INTERRUPTED


if __name__ == "__main__":
    # Imported under its own name, where jobs in other processes look up their function.
    from armscan.run import main as run_main

    sys.exit(run_main())
