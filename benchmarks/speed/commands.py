"""Measure the processor time of commands until they answer, and of a run until it trains, in fresh processes.

    python -m benchmarks.speed.commands [--before CHECKOUT]

Each figure is the least of several processes, after one that has compiled everything, made the phantoms and the store.
With `--before`, each process of this checkout follows one of the other, whose figure stands beside it. A command that
continues after the awaited line is killed there.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.repository import REPOSITORY, VOLUMES, environment
from benchmarks.speed.checkouts import children_processor_s, comparing_parser_of
from benchmarks.tables import print_head, print_row

N_PROCESSES = 3
RUN = "import sys; from armscan.__main__ import main; sys.exit(main())"
STUDY = ("run", "-m", "sweep=sac_y", "study.workers=1")
UNTIL_IT_TRAINS = (("run",), "training for at most")
# A command, and the beginning of the line that ends it; None if it ends by itself.
COMMANDS = {
    "first line of `run`": (("run",), ""),
    "first line of a grid": (("run", "-m", "agent=sac,ppo"), ""),
    "first line of a study": (STUDY, ""),
    "an invalid value, `run training.env_steps=-1`": (("run", "training.env_steps=-1"), None),
    "the same in each job of a grid": (("run", "-m", "training.env_steps=-1,-9"), None),
    "the same in a study, after its first line": ((*STUDY, "training.env_steps=-1"), None),
    "`run data=nifti` without a path": (("run", "data=nifti"), None),
    "`run resume=zzzz`": (("run", "resume=zzzz"), None),
    "`runs list`": (("runs", "list"), None),
    "`report --runs` of a run that does not exist": (("report", "--runs", "abcd"), None),
    "`ui`, without its servers": (("ui", "--mlflow-port", "5998", "--dashboard-port", "5999"), "runs "),
    "`data inspect`, four volumes": (("data", "inspect", str(VOLUMES)), None),
    "MLflow alone, its store opened": (None, None),
    "`run`, until it trains": UNTIL_IT_TRAINS,
}
STORE = "from mlflow import MlflowClient; MlflowClient('sqlite:///mlruns.db').search_experiments()"


def processor_s(checkout: Path, folder: str, words: tuple[str, ...] | None, until: str | None) -> float:
    """Return the processor seconds of a fresh process.

    Args:
        checkout: Folder of the code.
        folder: Working folder.
        words: Words of the command; None for MLflow alone.
        until: Beginning of the printed line at which the process is killed; None, if it ends by itself.
    """
    program = STORE if words is None else RUN
    before_s = children_processor_s()
    with subprocess.Popen(
        [sys.executable, "-c", program, *(words or ())],
        cwd=folder,
        env=environment(checkout),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if until is not None and line.startswith(until):
                os.killpg(process.pid, signal.SIGKILL)
    return children_processor_s() - before_s


def main() -> None:
    """Print the table."""
    other = comparing_parser_of(__doc__).parse_args().before
    checkouts = {**({"before": other} if other else {}), "now": REPOSITORY}
    print_head("processor seconds", *checkouts, align="---:")
    with tempfile.TemporaryDirectory() as folder:
        for checkout in checkouts.values():
            processor_s(checkout, folder, *UNTIL_IT_TRAINS)
        for name, command in COMMANDS.items():
            rounds = [[processor_s(each, folder, *command) for each in checkouts.values()] for _ in range(N_PROCESSES)]
            least = (min(column) for column in zip(*rounds, strict=True))
            print_row(name, *(f"{seconds:.1f}" for seconds in least))


if __name__ == "__main__":
    main()
