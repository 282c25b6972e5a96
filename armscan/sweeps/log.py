"""What a worker says of itself, in its log."""

from __future__ import annotations

from datetime import datetime


def say(text: str) -> None:
    """Writes a line into the worker's log."""
    print(f"{datetime.now():%Y-%m-%d %H:%M:%S}  {text}", flush=True)
