"""An MLflow store that can be unavailable for a while."""

from __future__ import annotations

import re
import uuid
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from armscan.config.credentials import mask_passwords
from armscan.config.trust import check_artifact_address
from armscan.errors import MAX_REASON_CHARS, TrackingUnavailableError, in_one_line
from armscan.tracking.sanitize import tags_of
from armscan.tracking.tags import PARENT_TAG
from armscan.utils.retry import RetryPolicy

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run
    from mlflow.store.artifact.artifact_repo import ArtifactRepository
    from mlflow.store.entities import PagedList

T = TypeVar("T")
# MLflow's error codes for a store that is unavailable, and for something that does not exist.
UNAVAILABLE, NOT_THERE = (
    ("INTERNAL_ERROR", "TEMPORARILY_UNAVAILABLE", "REQUEST_LIMIT_EXCEEDED"),
    "RESOURCE_DOES_NOT_EXIST",
)
# On a loaded server, a larger page would exceed the request timeout.
PER_PAGE = 100
# The informative part of an HTTP client's error message.
SHORT = re.compile(
    r"\[Errno -?\d+\] ([\w -]+)|(Connection reset by peer|Connection aborted|[Rr]ead timed out)|(too many 50\d)"
)
# Methods of `MlflowClient` that open the address of a run's artifacts; the run's ID is their first argument.
OF_ARTIFACTS = ("list_artifacts", "download_artifacts", "log_artifact", "log_artifacts")
# Tag of each run, by which a run is found again if the reply to its creation was lost.
MADE_TAG = "made"
# MLflow's column has no more; PostgreSQL refuses longer names.
MAX_RUN_NAME_CHARS = 250


class TrackingStore:
    """An open store with the methods of `MlflowClient`, which are retried while the store is unavailable.

    Args:
        connect: Function that opens the store.
        uri: Address of the store, without secrets.
        wait_s: Seconds that a run waits for an unavailable store at its end.
        retry_s: Seconds to retry at other times. Default: None, no retries.
        system_metrics_s: Seconds between two measurements of the machine while a run trains. Default: None, no
            measurements.
    """

    def __init__(
        self,
        connect: Callable[[], MlflowClient],
        uri: str,
        *,
        wait_s: float,
        retry_s: float | None = None,
        system_metrics_s: float | None = None,
    ) -> None:
        self.uri, self.wait_s, self.system_metrics_s = uri, wait_s, system_metrics_s
        self._retry_policy = None
        if retry_s is not None:
            named = f"tracking.uri is {uri!r}"
            self._retry_policy = RetryPolicy(
                "the tracking store", named, unavailable_reason, TrackingUnavailableError, retry_s=retry_s
            )
        # The client itself, which is not retried.
        self.mlflow = self._asked(connect)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        method = partial(self._asked, getattr(self.mlflow, name))
        return partial(self._with_artifacts, method) if name in OF_ARTIFACTS else method

    def _with_artifacts(self, method: Callable[..., T], run_id: str, *args: Any) -> T:
        self.check_artifacts_of(self.get_run(run_id))
        return method(run_id, *args)

    def check_artifacts_of(self, run: Run) -> None:
        """Raise `UntrustedError` if the artifacts of a run are on a server that is not the store's."""
        check_artifact_address(run.info.artifact_uri, self.uri)

    def artifacts(self, run: Run) -> ArtifactRepository:
        """Return the artifacts of a run, without reading the run again for each file, as `MlflowClient` does.

        Raises:
            UntrustedError: If they are on a server that is not the store's.
        """
        from mlflow.store.artifact.artifact_repository_registry import get_artifact_repository

        self.check_artifacts_of(run)
        return get_artifact_repository(run.info.artifact_uri, tracking_uri=self.mlflow.tracking_uri)

    def create_run(self, experiment_id: str, *, name: str, tags: Mapping[str, str]) -> Run:
        """Create exactly one run, even if the store becomes unavailable before it replies; a long name is cut."""
        made, n_asked = uuid.uuid4().hex, 0

        def create() -> Run:
            nonlocal n_asked
            n_asked += 1
            if n_asked > 1 and (found := self.mlflow.search_runs([experiment_id], f"tags.{MADE_TAG} = '{made}'")):
                return found[0]
            all_tags = {**tags_of(tags), MADE_TAG: made}
            return self.mlflow.create_run(experiment_id, run_name=name[:MAX_RUN_NAME_CHARS], tags=all_tags)

        return self._asked(create)

    def runs(self, experiment_ids: Sequence[str], condition: str = "") -> list[Run]:
        """Return all runs of experiments that match an MLflow filter, ordered by start time."""
        if not experiment_ids:
            return []
        order = ["attributes.start_time ASC"]
        return all_pages(partial(self.search_runs, [*experiment_ids], condition, order_by=order))

    def children(self, experiment_id: str, run_id: str) -> list[Run]:
        """Return the direct child runs of a run, ordered by start time."""
        return self.runs([experiment_id], f"tags.`{PARENT_TAG}` = '{run_id}'")

    def _asked(self, operate: Callable[..., T], *args: Any, **kwargs: Any) -> T:
        asked = partial(operate, *args, **kwargs)
        if self._retry_policy is not None:
            return self._retry_policy.call(asked)
        try:
            return asked()
        except Exception as error:
            if (reason := unavailable_reason(error)) is None:
                raise
            raise TrackingUnavailableError(
                f"tracking.uri is {self.uri!r}, but this store cannot be used: {reason}"
            ) from error


def all_pages(ask: Callable[..., PagedList[T]]) -> list[T]:
    """Return the results of all pages of an MLflow search."""
    found: list[T] = []
    token = None
    while True:
        page = ask(max_results=PER_PAGE, page_token=token)
        found += page
        if not (token := page.token):
            return found


def unavailable_reason(error: BaseException) -> str | None:
    """Return why a store is temporarily unavailable; None if the error means something else."""
    from mlflow.exceptions import MlflowException
    from requests import RequestException
    from sqlalchemy.exc import DBAPIError, OperationalError

    match error:
        case MlflowException(error_code=code):
            is_unavailable = code in UNAVAILABLE
        case RequestException(response=response) if response is not None:
            is_unavailable = response.status_code >= 500
        case DBAPIError():
            is_unavailable = error.connection_invalidated or isinstance(error, OperationalError)
        case _:
            is_unavailable = isinstance(error, OSError)
    return reason_in(error) if is_unavailable else None


def reason_in(error: BaseException) -> str:
    """Return the text of an error, short and without a password."""
    # SQLAlchemy's message ends with the statement and its parameters.
    text = mask_passwords(in_one_line(error)).partition(" [SQL: ")[0]
    if told := SHORT.search(text):
        return next(part for part in told.groups() if part).strip()
    return text[:MAX_REASON_CHARS]
