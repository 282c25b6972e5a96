"""Log lines of a process, and libraries silenced."""

from __future__ import annotations

import logging
import os
import warnings
from datetime import datetime

from armscan.errors import printable


def log(text: str) -> None:
    """Print a line that begins with the local time."""
    print(f"{datetime.now():%Y-%m-%d %H:%M:%S}  {printable(text)}", flush=True)


def silence_libraries() -> None:
    """Hide warnings of libraries that a user cannot act on, and turn off MLflow's telemetry."""
    # Read when MLflow is imported.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    for message in (
        "Gym has been unmaintained",
        ".*is an experimental feature.*",
        ".*Deprecat.*",
        ".*is not divisible by the number of test environments.*",
        # Our launcher settings are validated against the launcher's schema, as intended.
        r"\s*'hydra/launcher/.*' is validated against ConfigStore schema",
    ):
        warnings.filterwarnings("ignore", message=message)
    for category in (DeprecationWarning, FutureWarning, PendingDeprecationWarning):
        warnings.filterwarnings("ignore", category=category)
    # What Hydra logs about a missing class is in the error, too.
    logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)
    logging.getLogger("tianshou").setLevel(logging.ERROR)
    logging.getLogger("sensai").setLevel(logging.ERROR)
