"""The command `python -m armscan.report`: what a study or any runs have found, in one HTML file that needs no server.

    python -m armscan.report study=sac_y                  reports/sac_y/report.html, with its numbers as CSV beside it
    python -m armscan.report runs=4f2a,91c0               runs compared: reports/runs-4f2a...-91c0.../report.html

study=NAME          of the study
storage=URI         that it is in; ARMSCAN_STORAGE or optuna.journal where nothing is said
runs=ID,ID,...      ids of runs, or their beginnings: of trainings, of multiruns or of a study's trials, which stand for
                    all trainings below them; experiment:NAME for a whole experiment of MLflow
tracking=URI        that they are in; MLFLOW_TRACKING_URI or sqlite:///mlruns.db where nothing is said
out=FOLDER          takes the report; one in reports/ where nothing is said

It can be made while the study or the runs are going on. docs/reports.md says how to read it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from armscan.errors import InvalidValueError, StudyError, listed
from armscan.mistakes import quieten_libraries
from armscan.settings import usual_storage, usual_tracking
from armscan.words import answered, read_words

KEYS = ("study", "storage", "runs", "tracking", "out")
# Which key belongs to what the report is of.
PLACES = {"study": "storage", "runs": "tracking"}


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="the report may be incomplete")


def _run(words: Sequence[str]) -> int:
    values = read_words(words, KEYS, KEYS)
    subjects = [key for key in PLACES if key in values]
    if len(subjects) != 1:
        given = "study and runs are both given" if subjects else "neither study nor runs is set"
        raise InvalidValueError(
            f"{given}, but a report is of one of them: give study=NAME or runs=ID,ID (--help explains)"
        )
    for other, place in PLACES.items():
        if other not in subjects and place in values:
            raise InvalidValueError(f"{place} is given, but it is for {other}=, and this report is of {subjects[0]}=")
    _check_folder(values.get("out"))
    quieten_libraries()
    file = _of_study(values) if "study" in values else _of_runs(values)
    print(f"look at   {file}")
    return 0


def _of_study(values: Mapping[str, str]) -> Path:
    # Deferred: a mistake on the command line should be answered before these are loaded.
    import optuna

    from armscan.passwords import without_password
    from armscan.sweeps.reporting import write_report
    from armscan.sweeps.settings import JUDGED_SUFFIX, check_study_name
    from armscan.sweeps.storage import existing_storage
    from armscan.sweeps.study import is_ours

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
    return write_report(study, judged, Path(values.get("out", f"reports/{name}")))


def _of_runs(values: Mapping[str, str]) -> Path:
    from armscan.reports.runs import compare_runs

    return compare_runs(values["runs"], values.get("tracking", usual_tracking()["uri"]), values.get("out"))


def _check_folder(out: str | None) -> None:
    """Raises an error where a report's folder cannot be made, before the report is."""
    if out is not None:
        nearest = next(place for place in (Path(out), *Path(out).absolute().parents) if place.exists())
        if not nearest.is_dir():
            raise InvalidValueError(f"out is {out!r}, but {nearest} is no folder: name one, or what can become one")


def _which(names: Sequence[str]) -> str:
    """Returns which studies there are, for a message."""
    return f"there is only {listed(names)}" if names else "there is no study"


if __name__ == "__main__":
    sys.exit(main())
