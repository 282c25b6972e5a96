"""`armscan run -m sweep=NAME`: check a study, launch its workers, print its result."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from armscan.config.compose import compose_run
from armscan.config.credentials import check_address
from armscan.config.defaults import TRACKING_URI
from armscan.errors import printable
from armscan.launch.launchers import LAUNCHER, ON_THIS_MACHINE, check_launcher
from armscan.sweeps.results.console import print_result
from armscan.sweeps.scheduling.termination import reopen
from armscan.sweeps.storage.storage import existing_storage
from armscan.sweeps.study.arguments import STORAGE, StudyCommand, trial_overrides
from armscan.sweeps.study.components import check_space, read_settings
from armscan.sweeps.study.final_eval_storage import stored_final_eval
from armscan.sweeps.study.fixed_config import fixed_config
from armscan.sweeps.study.open import check_owner, open_for_work
from armscan.sweeps.study.plan import print_plan
from armscan.sweeps.study.population import population_of
from armscan.sweeps.study.study import existing_study, is_reconfigured
from armscan.sweeps.study.warm_start import initial_trials
from armscan.sweeps.tasks.attempt import volume_sums, volumes_of
from armscan.sweeps.workers.launch import run_workers
from armscan.utils.console import print_sentence
from armscan.utils.processes import EXIT_INTERRUPTED, n_usable_cores
from armscan.utils.text import counted


def run_study(arguments: Sequence[str], launch: Callable[[Sequence[str]], object]) -> int:
    """Run a study, or show what it would run.

    Returns:
        The exit code: 0 if there is a result, or the study was stopped or only shown; 130 if interrupted; 75 if its
        workers gave up, and the same command resumes it; else 1.
    """
    given = StudyCommand.read(arguments)
    overrides = trial_overrides(given.overrides)
    settings, task, config = read_settings(overrides)
    for key, uri in ((STORAGE, settings.storage), (TRACKING_URI, config.tracking.uri)):
        check_address(key, uri)
    launcher = compose_run(given.launching)[1][LAUNCHER]
    if launcher in ON_THIS_MACHINE:
        settings.check_workers(n_usable_cores())
    population = population_of(settings, config)
    # Before the space is checked, which takes seconds, and before anything is created.
    storage = existing_storage(settings.storage)
    volumes = volume_sums(volumes_of(config))
    fixed = fixed_config(config, overrides, volumes)
    existing = existing_study(storage, settings, fixed)
    if not given.is_plan:
        check_launcher(launcher)
    check_space(settings, task, overrides, config)
    initial = initial_trials(settings, overrides, fixed, existing)
    if given.is_plan:
        check_owner(Path(settings.folder), settings.name)
        final = None
        if storage is not None and existing is not None:
            final = stored_final_eval(storage, existing)
            if final is not None and is_reconfigured(existing, settings, fixed):
                print_sentence(
                    "the configuration has changed: all final trainings begin anew, and use the test volumes again"
                )
                final = None
        print_plan(settings, population, existing, final, initial)
        return 0
    opened = open_for_work(settings, task, config, overrides, volumes=volumes)
    search = opened.search.scheduler
    for each in initial:
        if each.add(search.storage, search.study):
            print_sentence(printable(each.message))
    if reopen(search.study, search.storage, settings.asked):
        print(f"{settings.name}: had ended early, and continues")
    blocked = [] if opened.final_eval is None else opened.final_eval.blocked()
    for phase in opened.phases:
        if phase.scheduler.resume():
            print(f"{phase.name}: was stopped, resuming")
        if n_failed := phase.scheduler.reset_failures(is_blocked=phase.name in blocked):
            print(f"{phase.name}: ignoring {counted(n_failed, 'failure')} before this start")
    try:
        run_workers(opened, given, launcher, launch)
    except KeyboardInterrupt:
        print("interrupted; the same command resumes the study", file=sys.stderr)
        return EXIT_INTERRUPTED
    return print_result(opened)
