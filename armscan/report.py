"""The command `python -m armscan.report`: what a study has found, in one HTML file that needs no server.

    python -m armscan.report study=sac_y                  reports/sac_y/report.html, with its numbers as CSV beside it

study=NAME          of the study
storage=URI         that it is in; optuna.journal where nothing is said
out=FOLDER          takes the report; reports/NAME where nothing is said

It can be made while the study is going on.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from armscan.errors import InvalidValueError, StudyError, listed
from armscan.mistakes import quieten_libraries
from armscan.words import answered, read_words

KEYS = ("study", "storage", "out")
USUAL_STORAGE = "optuna.journal"


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="the report may be incomplete")


def _run(words: Sequence[str]) -> int:
    values = read_words(words, KEYS, KEYS)
    if "study" not in values:
        raise InvalidValueError("study is not set, but it must be: give study=NAME (--help explains)")
    # Deferred: a mistake on the command line should be answered before these are loaded.
    import optuna

    from armscan.sweeps.judging import SUFFIX
    from armscan.sweeps.reporting import write_report
    from armscan.sweeps.storage import open_storage, without_password

    quieten_libraries()
    name, uri = values["study"], values.get("storage", USUAL_STORAGE)
    if "://" not in uri and not Path(uri).is_file():
        raise StudyError(f"storage is {uri!r}, but there is no such file: give the one that the study is in")
    storage = open_storage(uri).optuna
    names = optuna.get_all_study_names(storage)
    if name not in names or name.endswith(SUFFIX):
        there = [each for each in names if not each.endswith(SUFFIX)]
        raise StudyError(f"study is {name!r}, but {_which(there)} in {without_password(uri)!r}")
    judged = []
    if name + SUFFIX in names:
        judged = optuna.load_study(study_name=name + SUFFIX, storage=storage).get_trials(deepcopy=False)
    study = optuna.load_study(study_name=name, storage=storage)
    file = write_report(study, judged, Path(values.get("out", f"reports/{name}")))
    print(f"look at   {file}")
    return 0


def _which(names: Sequence[str]) -> str:
    """Returns which studies there are, for a message."""
    return f"there is only {listed(names)}" if names else "there is no study"


if __name__ == "__main__":
    sys.exit(main())
