"""Programs and privileges that some tests require: without them a test is skipped, but fails in CI."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest


def unavailable(reason: str) -> NoReturn:
    """Skip the test, or fail it where the environment variable CI is true.

    Args:
        reason: Name of what is missing, and how to install it.
    """
    (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(reason)
