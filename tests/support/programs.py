"""Python programs in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys

from tests.support import REPOSITORY


def output_of(program: str, *words: str, **environment: str) -> str:
    """Return what a program prints that is started in the repository."""
    command, variables = [sys.executable, "-c", program, *words], os.environ | environment
    return subprocess.run(command, cwd=REPOSITORY, env=variables, capture_output=True, text=True, check=True).stdout


def imported_by(program: str) -> set[str]:
    """Return the names of all modules that a program has imported at its end."""
    return set(output_of(f"{program}\nimport sys; print(*sys.modules)").splitlines()[-1].split())
