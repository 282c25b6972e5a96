"""The command `python -m armscan.track sync FOLDER`: what runs could not be rid of while their store was away.

    python -m armscan.track sync outputs             all runs in a folder, and in the folders in it
    python -m armscan.track sync studies/sac_y       all runs of a study

tracking=URI        the store, where it has another address now; where nothing is said, the one that each run names

What a run is to be tracked with is written into its folder first (tracking/*.jsonl), and delivered from there. What is
delivered once is not delivered again; runs that are still going on deliver for themselves.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from armscan.errors import InvalidValueError
from armscan.mistakes import quieten_libraries
from armscan.words import answered, read_words

COMMAND = "sync"


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code: 1 where something is left."""
    return answered(_run, words, usage=__doc__ or "", left="what is not delivered is still there")


def _run(words: Sequence[str]) -> int:
    folder, uri = _read(words)
    # Deferred: a mistake on the command line should be answered before these are loaded.
    from armscan.tracking import open_existing_store, sync

    quieten_libraries()
    opened = cache(lambda tracked_in: open_existing_store(uri or tracked_in))
    deliveries = sync(folder, opened)
    for delivery in deliveries:
        which = f"run {delivery.run_id}" if delivery.run_id else "a run"
        left = f", the rest is left: {delivery.left}" if delivery.left else ""
        print(f"{which} in {delivery.folder}: {delivery.n_entries} entries delivered{left}")
    if not deliveries:
        print(f"{folder}: nothing is left to be delivered")
    return 1 if any(delivery.left for delivery in deliveries) else 0


def _read(words: Sequence[str]) -> tuple[Path, str | None]:
    """Returns the folder, and the address of the store where one is given."""
    plain = [word for word in words if "=" not in word]
    if len(plain) != 2 or plain[0] != COMMAND:
        given = " ".join(words) or "nothing"
        raise InvalidValueError(f"{given!r} cannot be read: give {COMMAND} FOLDER (--help explains)")
    values = read_words([word for word in words if "=" in word], ("tracking",), ("tracking",))
    folder = Path(plain[1])
    if not folder.is_dir():
        raise InvalidValueError(f"the folder is {plain[1]!r}, but there is no such folder")
    return folder, values.get("tracking")


if __name__ == "__main__":
    sys.exit(main())
