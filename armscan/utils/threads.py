"""How many threads libraries compute with; they read it when they are loaded."""

from __future__ import annotations

import os

VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def limit_threads() -> None:
    """Set one compute thread for this process, where nobody has said otherwise, before a library starts its pool.

    Small networks are fastest so, and jobs side by side never claim more threads than there are cores.
    """
    for variable in VARIABLES:
        os.environ.setdefault(variable, "1")
