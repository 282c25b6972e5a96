"""Changes to Optuna's dashboard: attributes, progress, links, and the button that fails a trial."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

from armscan.config.services import MLFLOW_PORT
from armscan.errors import StudyError
from armscan.sweeps.storage import attribute_names as names

if TYPE_CHECKING:
    from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

STUDIES = re.compile(r"/api/studies(/\d+)?")
# The address in notes that link to runs in a local store, which no MLflow server serves all the time.
LOCAL_RUNS = re.compile(rf"http://127\.0\.0\.1:{MLFLOW_PORT}(?=/#/)")
# Attributes that identify trials of armscan.
OF_TRIAL = {names.LEASE, names.CONFIG_SHA256, names.FINALIST}
HIDDEN_OF_STUDY = names.OF_STUDY | {names.STUDY_RUN, names.BEGUN_IN, names.NOTE_SUM, names.RESET_FAILURES}
# The note has the run, the folder and the metrics of the seeds.
HIDDEN = {
    *(names.LEASE, names.METRICS, names.SEEDS, names.CONFIG_SHA256, names.OF_CONFIG),
    *(names.ATTEMPT, names.RETRIED, names.DROPPED, names.RUN, names.FOLDER, names.PRUNED_AT),
}
NAMES = {
    names.ENV_STEPS: "environment steps",
    names.RETRY_OF: "retry of trial",
    names.FINALIST: "final training of trial (-1: the control)",
    names.FINAL_SEED: "seed",
    names.STOP: "stopped",
}
# Progress of a running trial, from its worker's lease.
PROGRESS = {"worker": "worker", "seed": "seed", names.ENV_STEPS: "environment steps", "return": "return, mean"}
TELL = re.compile(r"/api/trials/(\d+)/tell")


class DashboardView:
    """WSGI middleware that changes the responses of Optuna's dashboard; studies not made by armscan stay as they are.

    Args:
        application: WSGI application of Optuna's dashboard.
        stop: Function that asks the worker of a trial, by its ID in the storage, to end it; returns whether there is a
            worker, and raises `StudyError` if the trial must go on. The button that fails a running trial calls it: the
            worker keeps its results, and the trial ends as pruned.
        mlflow: Address of MLflow's UI for the links in notes; None: the links stay as they are.
    """

    def __init__(self, application: WSGIApplication, stop: Callable[[int], bool], mlflow: str | None) -> None:
        self._application, self._stop, self._mlflow = application, stop, mlflow

    def __call__(self, environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        """Answer a request."""
        told = TELL.fullmatch(environ.get("PATH_INFO", ""))
        if told and environ["REQUEST_METHOD"] == "POST":
            try:
                if self._stop(int(told[1])):
                    start_response("204 No Content", [("Content-Length", "0")])
                    return []
            except StudyError as error:
                # As Optuna's dashboard answers, which shows the reason.
                reason = json.dumps({"reason": str(error)}).encode()
                head = [("Content-Type", "application/json"), ("Content-Length", str(len(reason)))]
                start_response("409 Conflict", head)
                return [reason]
        if environ["REQUEST_METHOD"] != "GET" or not STUDIES.fullmatch(environ.get("PATH_INFO", "")):
            return self._application(environ, start_response)
        answered: list[tuple[str, list[tuple[str, str]]]] = []

        def keep(status: str, headers: list[tuple[str, str]], *_: Any) -> Any:
            answered.append((status, headers))

        body = b"".join(self._application(environ, keep))
        status, headers = answered[-1]
        if status.startswith("200"):
            body = self._shown(body)
        kept = [header for header in headers if header[0].lower() != "content-length"]
        start_response(status, [*kept, ("Content-Length", str(len(body)))])
        return [body]

    def _shown(self, body: bytes) -> bytes:
        text = body.decode()
        if self._mlflow is not None:
            text = LOCAL_RUNS.sub(lambda _: str(self._mlflow), text)
        answer = json.loads(text)
        for study in (answer, *answer.get("study_summaries", ())):
            if {each["key"] for each in study.get("user_attrs", ())} >= names.OF_STUDY:
                study["user_attrs"] = [each for each in study["user_attrs"] if each["key"] not in HIDDEN_OF_STUDY]
        trials = [*answer.get("trials", ()), *answer.get("best_trials", ())]
        ours = [trial for trial in trials if OF_TRIAL & {each["key"] for each in trial["user_attrs"]}]
        for trial in ours:
            trial["user_attrs"] = _attributes(trial)
        if ours:
            columns = [each for each in answer["union_user_attrs"] if each["key"] not in HIDDEN]
            answer["union_user_attrs"] = [each | {"key": NAMES.get(each["key"], each["key"])} for each in columns]
        return json.dumps(answer).encode()


def _attributes(trial: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the attributes that are shown of a trial; of a running one, its progress, too."""
    values = {each["key"]: each["value"] for each in trial["user_attrs"]}
    shown = {NAMES.get(key, key): value for key, value in values.items() if key not in HIDDEN}
    if trial["state"] == "Running":
        lease: Any = {}
        with contextlib.suppress(ValueError):
            lease = json.loads(values.get(names.LEASE, "{}"))
        if isinstance(lease, dict):
            progress = {name: lease[key] for key, name in PROGRESS.items() if key in lease}
            shown |= {
                name: f"{value:.4g}" if isinstance(value, float) else str(value) for name, value in progress.items()
            }
    return [{"key": key, "value": value} for key, value in shown.items()]
