"""Processes that run the code of a checkout, and those that measure it on request.

A script that is run with `--serve` reads the name of a case from each line of its input, and answers with a line: what
it measured, in JSON. `start` runs the same script for any checkout: `armscan` is that checkout's, `benchmarks` ours.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.arguments import count, parser_of
from benchmarks.repository import REPOSITORY, environment

PROGRAM = f"""
import runpy, sys
import armscan
sys.path.insert(0, {str(REPOSITORY)!r})
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def comparing_parser_of(description: str | None, n_rounds: int | None = None) -> argparse.ArgumentParser:
    """Return a parser of the option `--before`, an absolute path or None, and of `--rounds` if it has a default."""
    parser = parser_of(description)
    what = "another checkout to compare with"
    parser.add_argument("--before", type=_checkout, metavar="CHECKOUT", help=what)
    if n_rounds:
        parser.add_argument("--rounds", type=count, default=n_rounds, help=f"turns of each (default: {n_rounds})")
    return parser


def _checkout(given: str) -> Path:
    folder = Path(given).resolve()
    # Otherwise the installed version would be imported, and compared with itself.
    if not (folder / "armscan" / "__init__.py").is_file():
        raise argparse.ArgumentTypeError(f"{given} is no checkout of armscan: it has no armscan/__init__.py")
    return folder


def children_processor_s() -> float:
    """Return the processor seconds of all processes that this one has started and waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_timed(checkout: Path, folder: str | Path, *words: str, **variables: str) -> tuple[str, float, float]:
    """Run Python in a folder with the code of a checkout; return its output, and its processor and wall seconds."""
    command, env = [sys.executable, *words], environment(checkout, **variables)
    before_s, start_s = children_processor_s(), time.perf_counter()
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=True)
    return done.stdout, children_processor_s() - before_s, time.perf_counter() - start_s


def start(script: str, checkout: Path) -> subprocess.Popen[str]:
    """Start a script that serves, with the code of a checkout, on one thread; it ends when its context is left."""
    # -P: the working folder has another `armscan`.
    return subprocess.Popen(
        [sys.executable, "-P", "-c", PROGRAM, script, "--serve"],
        env=environment(checkout, NUMBA_NUM_THREADS="1"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def ask(process: subprocess.Popen[str], case: str) -> Any:
    """Return what a process measures for a case."""
    return ask_all([process], case)[0]


def ask_all(processes: Sequence[subprocess.Popen[str]], case: str) -> list[Any]:
    """Return what each process measures for a case, all at the same time."""
    for process in processes:
        assert process.stdin is not None
        print(json.dumps(case), file=process.stdin, flush=True)
    return [json.loads(process.stdout.readline()) for process in processes if process.stdout]


def serve(measure: Callable[[str], Any]) -> None:
    """Answer each case that is asked for with what it measures."""
    # What is logged must not look like an answer.
    answers, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        print(json.dumps(measure(json.loads(line))), file=answers, flush=True)
