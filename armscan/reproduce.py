"""The command `python -m armscan.reproduce RUN_ID`: a run once more, and whether the same comes of it.

    python -m armscan.reproduce 3bf2                  what differs now; the run again; its metrics compared
    python -m armscan.reproduce 3bf2 run=false        what differs now, and nothing else

RUN_ID              the run's id, or its beginning, as the UI shows it
run=true            whether it is run again; false for a look at what differs
out=FOLDER          takes the files of the new run; reproductions/ID-TIME where nothing is said
tracking=URI        the store; MLFLOW_TRACKING_URI or sqlite:///mlruns.db where nothing is said

Nothing is checked out or installed: code, packages and machine are those that are there, and what differs from those
that the run was made with is listed. The volumes must be the same. The new run has the configuration and the seed of
the old one, and is tracked beside it. Exit code: 0 if all metrics are the same (with run=false: if
nothing differs), 1 if not,
2 for a mistake.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from armscan.checks import check_bool
from armscan.errors import InvalidValueError
from armscan.mistakes import quieten_libraries
from armscan.settings import usual_tracking
from armscan.threads import one_a_process
from armscan.words import answered, read_words

KEYS, TEXTS = ("run", "out", "tracking"), ("out", "tracking")
FOLDER = Path("reproductions")


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="the reproduction is not complete")


def _run(words: Sequence[str]) -> int:
    ids = [word for word in words if "=" not in word]
    if len(ids) != 1:
        given = " ".join(ids) or "nothing"
        raise InvalidValueError(f"the run is {given!r}, but it must be one id: give RUN_ID (--help explains)")
    values = read_words([word for word in words if "=" in word], KEYS, TEXTS)
    is_to_run = check_bool("run", values.get("run", True))
    # As a run is computed.
    one_a_process()
    # Deferred: a mistake on the command line should be answered before these are loaded.
    from armscan import reproducing

    quieten_libraries()
    original = reproducing.original_of(values.get("tracking", usual_tracking()["uri"]), ids[0])
    differences = reproducing.differences(original)
    print(f"run {original.run.run_id}: {original.run.name}")
    for difference in differences:
        print(f"differs: {difference}")
    if not differences:
        print("code, packages, machine and volumes are those that it was made with")
    if not is_to_run:
        return 1 if differences else 0
    now = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    folder = Path(values.get("out", FOLDER / f"{original.run.run_id[:8]}-{now}"))
    comparison = reproducing.reproduced(original, folder, differences)
    for line in comparison.lines():
        print(line)
    return 0 if comparison.is_same else 1


if __name__ == "__main__":
    sys.exit(main())
