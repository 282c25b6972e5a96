"""What a worker's process does from its beginning to its end: one phase of the study after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from armscan.log import say
from armscan.mistakes import quieten_libraries
from armscan.sweeps.clearing import close_runs_of
from armscan.sweeps.lease import Keeper
from armscan.sweeps.opening import open_for_work, read_settings
from armscan.sweeps.phases import Phase
from armscan.sweeps.worker import Worker


def work(
    words: Sequence[str],
    name: str,
    is_told_to_leave: Callable[[], bool],
    *,
    is_told_to_leave_soon: Callable[[], bool],
    leave: Callable[[], None],
) -> None:
    """Works at a study until it is over.

    Args:
        words: of the study.
        name: of the worker.
        is_told_to_leave: see `Keeper`.
        is_told_to_leave_soon: likewise.
        leave: likewise.

    Raises:
        AwayError: if the storage or the tracking store is away for longer than a worker waits.
    """
    quieten_libraries()
    opened = open_for_work(*read_settings(words), words, is_patient=True)

    def worked(phase: Phase) -> str:
        keeper = Keeper(
            phase.ledger,
            name,
            is_told_to_leave=is_told_to_leave,
            is_told_to_leave_soon=is_told_to_leave_soon,
            leave=leave,
            on_death=partial(close_runs_of, phase=phase),
        )
        with keeper.at_work():
            reason = Worker(phase, words, keeper).work()
        say(f"{phase.name}: {reason}")
        return reason

    searching = opened.searching()
    worked(searching)
    tally = searching.ledger.tally()
    if opened.settings.judging.best and tally.finished and not searching.ledger.broken(tally):
        worked(opened.judging())
