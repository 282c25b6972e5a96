"""The command `python -m armscan.runs`: the runs of a store in the terminal, and the removal of old ones.

    python -m armscan.runs list status=failed,killed since=7d     a table, the newest first
    python -m armscan.runs list sort=-size limit=10               what takes the disk
    python -m armscan.runs show ID                                everything of one run
    python -m armscan.runs prune what=checkpoints before=30d      what would be removed; apply=true removes it

experiment=NAME     of MLflow; all where nothing is said
status=finished     or failed, killed, running; several with commas
agent=sac, obs=cluster, projection=zy    as the runs were started; several with commas
since=7d            started then or later: an age (90m, 12h, 7d, 4w) or a date (2026-01-31, 2026-01-31T18:00)
before=30d          started earlier
where="metrics.`test_volumes/success_rate` < 0.5"    a filter of MLflow
parent=ID           children of a multirun, a study, or a run that was evaluated
sort=-started       or duration, success, steps, size; - for descending
limit=20            so many
tracking=URI        the store, MLFLOW_TRACKING_URI or sqlite:///mlruns.db where nothing is said
format=table        of a list; csv or json for scripts
children=true       of a list: children stand below their parents, not folded into them
what=checkpoints    to be pruned: checkpoints of runs that have ended, from their folders; folders of such runs, on
                    this machine; runs, with their artifacts and folders
apply=true          prune; without it nothing is touched

docs/runs.md says what is never removed.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from armscan.errors import InvalidValueError, listed
from armscan.mistakes import quieten_libraries
from armscan.settings import usual_tracking
from armscan.words import answered, read_words

if TYPE_CHECKING:
    from armscan.tracking import TrackingStore

FILTERS = (
    *("experiment", "status", "agent", "obs", "projection", "since", "before", "where", "parent", "sort", "limit"),
    "tracking",
)
KEYS = {
    "list": (*FILTERS, "format", "children"),
    "show": ("tracking",),
    "prune": (*FILTERS, "what", "apply"),
}
# Those whose values are not texts.
PARSED = ("limit", "children", "apply")


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code: 1 where something could not be removed."""
    return answered(_run, words, usage=__doc__ or "", left="what was not removed by now is still there")


def _run(words: Sequence[str]) -> int:
    command, run_id, values = _read(words)
    # Deferred: a mistake on the command line should be answered before these are loaded.
    from armscan.tracking import open_existing_store
    from armscan.tracking.store import usable_store

    quieten_libraries()
    uri = values.get("tracking", usual_tracking()["uri"])
    client = open_existing_store(uri)
    with usable_store(client.uri):
        match command:
            case "show":
                return _show(client, run_id, uri)
            case "list":
                return _list(client, values)
            case _:
                return _prune(client, values, words)


def _read(words: Sequence[str]) -> tuple[str, str, dict[str, Any]]:
    """Returns the command, the run that it is about, and its values by key."""
    commands = listed(KEYS)
    if not words or words[0] not in KEYS:
        raise InvalidValueError(f"{' '.join(words) or 'nothing'!r} cannot be read: give {commands} (--help explains)")
    command, rest = words[0], list(words[1:])
    run_id = ""
    if command == "show":
        if not rest or "=" in rest[0]:
            raise InvalidValueError("no run is named: give show ID, or the first four or more characters of it")
        run_id = rest.pop(0)
    texts = [key for key in KEYS[command] if key not in PARSED]
    values = read_words(rest, KEYS[command], texts)
    for key in ("children", "apply"):
        if not isinstance(values.get(key, False), bool):
            raise InvalidValueError(f"{key} is {values[key]!r}, but it must be true or false")
    return command, run_id, values


def _show(client: TrackingStore, run_id: str, uri: str) -> int:
    from armscan.inventory import show
    from armscan.tracking import find_run

    show(client, find_run(client, run_id), uri)
    return 0


def _list(client: TrackingStore, values: Mapping[str, Any]) -> int:
    from armscan.inventory import FORMATS, Sizes, find, folded, ordered, read_selection, unfolded, write_entries

    form = _one_of("format", values.get("format", "table"), FORMATS)
    selection = read_selection(values)
    runs = find(client, selection)
    entries = ordered(folded(runs, Sizes(client)), selection.sort, is_down=selection.is_down)[: selection.limit]
    if not entries and form == "table":
        print(f"no run of {client.uri} is meant")
        return 0
    write_entries(unfolded(entries, runs) if values.get("children") else entries, form)
    return 0


def _prune(client: TrackingStore, values: Mapping[str, Any], words: Sequence[str]) -> int:
    from armscan.inventory import (
        RUNS,
        WHAT,
        Sizes,
        find,
        half_removed,
        ordered,
        plan,
        print_plan,
        read_selection,
        readable,
    )
    from armscan.inventory.entries import Entry

    if "what" not in values:
        raise InvalidValueError(f"what is not set, but it must be: give what={listed(WHAT)}")
    what = _one_of("what", values["what"], WHAT)
    selection = read_selection(values)
    sizes = Sizes(client)
    runs = find(client, selection)
    if what == RUNS:
        runs += half_removed(client, selection, sizes)
    entries = [Entry(run, sizes) for run in runs]
    meant = ordered(entries, selection.sort, is_down=selection.is_down)[: selection.limit]
    cases = plan(client, [entry.run for entry in meant], what, sizes)
    if values.get("apply"):
        return _carry_out(client, cases, what)
    print_plan(cases)
    taken = [case for case in cases if case.left is None]
    freed = readable(sum(case.n_bytes for case in taken))
    print(f"{what} of {len(taken)} of {len(cases)} runs would be removed, {freed}; nothing is touched")
    if taken:
        again = [word for word in words if not word.startswith("apply=")]
        print(f"remove it {shlex.join(['python', '-m', 'armscan.runs', *again, 'apply=true'])}")
    return 0


def _carry_out(client: TrackingStore, cases: Sequence[Any], what: str) -> int:
    from armscan.inventory import LeftError, NotRemovedError, readable, remove
    from armscan.tracking.client import reason_in

    freed, n_removed, n_failed = 0, 0, 0
    for case in cases:
        run_id = case.run.info.run_id
        if case.left is not None:
            print(f"{run_id} stays: {case.left}")
            continue
        try:
            note = remove(client, case, what)
        except LeftError as error:
            print(f"{run_id} stays: {error}")
        # Whatever a store raises: the other runs have nothing to do with it.
        except Exception as error:
            n_failed += 1
            reason = error if isinstance(error, NotRemovedError) else reason_in(error)
            print(f"{run_id} is not removed: {reason}", file=sys.stderr)
        else:
            freed, n_removed = freed + case.n_bytes, n_removed + 1
            print(f"{run_id} removed, {readable(case.n_bytes)}" + (f"; {note}" if note else ""), flush=True)
    print(f"{what} of {n_removed} of {len(cases)} runs removed, {readable(freed)}")
    return 1 if n_failed else 0


def _one_of(key: str, value: str, allowed: Sequence[str]) -> str:
    if value not in allowed:
        raise InvalidValueError(f"{key} is {value!r}, but it must be {listed(allowed)}")
    return value


if __name__ == "__main__":
    sys.exit(main())
