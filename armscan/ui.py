"""The command `python -m armscan.ui`: MLflow's UI and Optuna's dashboard over what is there, for this machine alone.

    python -m armscan.ui                          the studies and runs of this folder, in the browser

storage=URI             of the studies: a journal file, sqlite:///FILE or postgresql://..., with its password in
                        ARMSCAN_STORAGE_PASSWORD; ARMSCAN_STORAGE or optuna.journal where nothing is said
tracking=URI            of the runs: sqlite:///FILE, postgresql://... (ARMSCAN_TRACKING_PASSWORD), or an MLflow server,
                        which has a UI of its own; MLFLOW_TRACKING_URI or sqlite:///mlruns.db where nothing is said
artifacts=FOLDER        of the pictures in the dashboard; optuna.artifacts where nothing is said
mlflow_port=NUMBER      of 127.0.0.1; 5000 where nothing is said
dashboard_port=NUMBER   likewise; 8080 where nothing is said

What is named must be there; of the usual places one may still be empty. Ctrl-C ends both, with exit code 130; where one
ends by itself, so does the other, with exit code 1.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from armscan.checks import check_int
from armscan.errors import InvalidValueError, ServerError
from armscan.looking import Place, Request, place_of_runs, place_of_studies
from armscan.servers import Server, running, wait_until_answering, watch
from armscan.settings import usual_storage, usual_tracking
from armscan.words import answered, read_words

TEXTS = ("storage", "tracking", "artifacts")
USUAL_PORTS = {"mlflow_port": 5000, "dashboard_port": 8080}
MAX_PORT = 65_535
USUAL_ARTIFACTS = "optuna.artifacts"


def parse(words: Sequence[str]) -> Request:
    """Returns what `key=value` words ask for.

    Raises:
        InvalidValueError: if a word is something else, a key unknown, or a value not allowed.
    """
    values = read_words(words, (*TEXTS, *USUAL_PORTS), TEXTS)
    mlflow_port, dashboard_port = (
        check_int(key, values.get(key, usual), at_least=1, at_most=MAX_PORT) for key, usual in USUAL_PORTS.items()
    )
    request = Request(
        storage=values.get("storage") or usual_storage(),
        tracking=values.get("tracking") or usual_tracking()["uri"],
        artifacts=Path(values.get("artifacts", USUAL_ARTIFACTS)),
        mlflow_port=mlflow_port,
        dashboard_port=dashboard_port,
        named=frozenset(values),
    )
    if mlflow_port == dashboard_port:
        raise InvalidValueError(f"mlflow_port and dashboard_port are both {mlflow_port}, but each must have its own")
    if request.has_tracking_server and "mlflow_port" in values:
        raise InvalidValueError(
            f"mlflow_port is {mlflow_port}, but the runs are kept by a server, which has a UI of its own"
        )
    if "artifacts" in values and not request.artifacts.is_dir():
        raise InvalidValueError(f"artifacts is {values['artifacts']!r}, but there is no such folder")
    return request


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="nothing is left running")


def _run(words: Sequence[str]) -> int:
    request = parse(words)
    places = [place_of_studies(request), place_of_runs(request)]
    _check_places(places, request)
    servers = [place.server for place in places if place.is_there and place.server is not None]
    for server in servers:
        server.check_port()
    for place in places:
        if not place.is_there:
            print(f"note: there are no {place.what} in {place.shown!r} yet; {place.key}=URI names others")
        elif place.server is None:
            print(f"{place.what:<10}{place.shown}")
    return _serve(servers) if servers else 0


def _check_places(places: Sequence[Place], request: Request) -> None:
    """Raises the error of a place that was named and where nothing is, or of all where nothing is anywhere."""
    missing = [place for place in places if not place.is_there]
    for place in missing:
        if place.key in request.named:
            why = "no server answers there" if place.server is None else f"there are no {place.what} there"
            raise InvalidValueError(f"{place.key} is {place.shown!r}, but {why}")
    if len(missing) == len(places):
        nowhere = " and ".join(f"no {place.what} in {place.shown!r}" for place in places)
        raise InvalidValueError(f"there is nothing to look at, {nowhere}: give storage=URI or tracking=URI")


def _serve(servers: Sequence[Server]) -> int:
    """Runs servers until they are interrupted, or one of them ends; returns the exit code."""
    try:
        with running(servers) as processes:
            for process in processes:
                wait_until_answering(process, processes)
                print(f"{process.server.program:<10}{process.server.address}{process.server.hint}", flush=True)
            print(f"Ctrl-C ends {'both' if len(processes) > 1 else 'it'}", flush=True)
            watch(processes)
    except ServerError as error:
        print(f"error: {error}; the end of its log:\n{error.log}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
