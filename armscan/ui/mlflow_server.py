"""Child process of `armscan ui`: MLflow's server, which ends with its parent.

python -m armscan.ui.mlflow_server [OPTION...]
"""

from __future__ import annotations

import os
import signal
import sys
import time

from armscan.utils.processes import on_parent_exit

END_S = 5.0


def end_group() -> None:
    """End this process and its children, which are a process group."""
    os.killpg(0, signal.SIGTERM)
    time.sleep(END_S)
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    on_parent_exit(end_group)
    from mlflow.cli import cli

    cli(["server", *sys.argv[1:]])
