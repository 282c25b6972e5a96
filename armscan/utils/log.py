"""What a process says of itself while it works: in the log of a worker, or on the screen."""

from __future__ import annotations

from datetime import datetime


def log(text: str) -> None:
    """Print a line with the time; what a worker prints is its log."""
    print(f"{datetime.now():%Y-%m-%d %H:%M:%S}  {text}", flush=True)
