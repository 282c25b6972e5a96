"""`python -m armscan.run -m sweeps=NAME`: a study is checked, its workers launched, its result told."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence

from armscan.launchers import LAUNCHER, ON_THIS_MACHINE, check_launcher
from armscan.mistakes import quieten_libraries
from armscan.passwords import check_written
from armscan.settings import TRACKING_URI, plain
from armscan.sweeps.attempt import composed
from armscan.sweeps.checking import check_space
from armscan.sweeps.command_line import STORAGE, CommandLine
from armscan.sweeps.launching import run_workers
from armscan.sweeps.opening import open_for_work, read_settings
from armscan.sweeps.planning import print_plan
from armscan.sweeps.screen import print_result
from armscan.sweeps.study import existing_study


def run_study(words: Sequence[str], launch: Callable[[Sequence[str]], object]) -> int:
    """Runs a study, or shows what it would run.

    Args:
        words: of the command line.
        launch: runs the command with Hydra, with the words it is given.

    Returns:
        The exit code: 0 where there is a result, 1 where too many trials failed.

    Raises:
        InvalidValueError: if the words are not allowed.
        StudyError: see `open_for_work`.
        TrackingError: likewise.
    """
    given = CommandLine.read(words)
    quieten_libraries()
    settings, task, config = read_settings(given.of_trials)
    for key, uri in ((STORAGE, settings.storage), (TRACKING_URI, config.tracking.uri)):
        check_written(key, uri)
    launcher = composed(given.launching)[1][LAUNCHER]
    if launcher in ON_THIS_MACHINE:
        settings.check_workers(len(os.sched_getaffinity(0)))
    check_space(settings, task, given.of_trials, config)
    # Before anything is made: a study or a storage that would be refused.
    existing = existing_study(settings, plain(config))
    if given.is_plan or settings.plan:
        print_plan(settings, existing)
        return 0
    check_launcher(launcher)
    opened = open_for_work(settings, task, config, given.of_trials)
    for phase in opened.begun():
        if n_failed := phase.ledger.forgive():
            print(f"{phase.name}: {n_failed} trials have failed before, which count no more from now on")
    try:
        run_workers(opened, given, launcher, launch)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on with the study", file=sys.stderr)
        return 130
    return print_result(opened)
