"""The command `python -m armscan.report`: what a study has found, in one HTML file that needs no server.

    python -m armscan.report study=sac_y                  reports/sac_y/report.html, with its numbers as CSV beside it

study=NAME          of the study
storage=URI         that it is in; ARMSCAN_STORAGE or optuna.journal where nothing is said
out=FOLDER          takes the report; reports/NAME where nothing is said

It can be made while the study is going on.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from armscan.errors import InvalidValueError, StudyError, listed
from armscan.mistakes import quieten_libraries
from armscan.settings import usual_storage
from armscan.words import answered, read_words

KEYS = ("study", "storage", "out")


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="the report may be incomplete")


def _run(words: Sequence[str]) -> int:
    values = read_words(words, KEYS, KEYS)
    if "study" not in values:
        raise InvalidValueError("study is not set, but it must be: give study=NAME (--help explains)")
    # Deferred: a mistake on the command line should be answered before these are loaded.
    import optuna

    from armscan.passwords import without_password
    from armscan.sweeps.reporting import write_report
    from armscan.sweeps.settings import JUDGED_SUFFIX, check_study_name
    from armscan.sweeps.storage import existing_storage
    from armscan.sweeps.study import is_ours

    quieten_libraries()
    name, uri = check_study_name("study", values["study"]), values.get("storage", usual_storage())
    storage = existing_storage(uri, where="storage")
    if storage is None:
        raise StudyError(f"storage is {without_password(uri)!r}, but nothing is there: give the one that it is in")
    names = optuna.get_all_study_names(storage.optuna)
    if name not in names:
        there = [each for each in names if not each.endswith(JUDGED_SUFFIX)]
        raise StudyError(f"study is {name!r}, but {_which(there)} in {storage.uri!r}")
    study = optuna.load_study(study_name=name, storage=storage.optuna)
    if not is_ours(study):
        raise StudyError(f"study is {name!r}, but that one in {storage.uri!r} was not made by armscan")
    judged = []
    if name + JUDGED_SUFFIX in names:
        judged = optuna.load_study(study_name=name + JUDGED_SUFFIX, storage=storage.optuna).get_trials(deepcopy=False)
    file = write_report(study, judged, Path(values.get("out", f"reports/{name}")))
    print(f"look at   {file}")
    return 0


def _which(names: Sequence[str]) -> str:
    """Returns which studies there are, for a message."""
    return f"there is only {listed(names)}" if names else "there is no study"


if __name__ == "__main__":
    sys.exit(main())
