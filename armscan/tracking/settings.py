"""Settings of tracking: a store, its experiment, and what runs keep there."""

from __future__ import annotations

from typing import Any, Self
from urllib.parse import urlsplit

from pydantic import Field, model_validator

from armscan.config.credentials import check_address
from armscan.errors import TrackingError
from armscan.utils.files import SQLITE_PREFIX
from armscan.utils.section import Section

EXAMPLES = {"uri": "sqlite:///mlruns.db", "experiment": "armscan", "artifacts": "mlartifacts"}
# MLflow's length limit for an experiment's name and artifact location, and how much of a longer one an error shows.
MAX_TEXT_CHARS, N_SHOWN_CHARS = 500, 40


class TrackingSettings(Section):
    """The section `tracking` of the configuration; see `open_store`."""

    uri: Any
    experiment: Any
    artifacts: Any
    wait_s: float = Field(ge=0.0, allow_inf_nan=False, description="a finite number at least 0")
    system_metrics_s: float | None = Field(
        None, gt=0.0, allow_inf_nan=False, description="a finite number above 0, or null"
    )
    policy: bool = Field(True, description="true or false")

    @model_validator(mode="after")
    def _has_valid_texts(self) -> Self:
        _check_texts(uri=self.uri, experiment=self.experiment, artifacts=self.artifacts)
        check_uri(self.uri)
        return self


def check_uri(uri: str) -> None:
    """Raise `TrackingError` if a tracking URI is not the address of a store."""
    _check_texts(uri=uri)
    check_address("tracking.uri", uri)
    try:
        is_server = not uri.startswith("http") or (urlsplit(uri).port != 0 and bool(urlsplit(uri).hostname))
    except ValueError:
        is_server = False
    if not is_server:
        raise TrackingError(
            f"tracking.uri is {uri!r}, but a server's address must have a host, such as http://127.0.0.1:5000"
        )


def _check_texts(**values: object) -> None:
    for name, value in values.items():
        if not isinstance(value, str) or not value.strip() or value == SQLITE_PREFIX:
            raise TrackingError(f"tracking.{name} is {value!r}, but it must be a string such as {EXAMPLES[name]!r}")
        if len(value) > MAX_TEXT_CHARS:
            raise TrackingError(
                f"tracking.{name} begins with {value[:N_SHOWN_CHARS]!r} and has {len(value)} characters, but it must "
                f"have at most {MAX_TEXT_CHARS}"
            )
