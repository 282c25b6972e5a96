"""Processes that measure on request, each with the code of a checkout.

A script that is run with `--serve` reads the name of a case from each line of its input, and answers with a line: what
it measured, in JSON. With `PYTHONPATH` set to another checkout, the same script measures that checkout's code, so it
must not import from `benchmarks` at its top.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[2]


def parser_of(description: str) -> argparse.ArgumentParser:
    """Return a parser of the options of a script that serves: the checkout, and the number of rounds."""
    parser = argparse.ArgumentParser(description=description.partition("\n")[0])
    parser.add_argument("--before", type=Path, metavar="CHECKOUT", help="another checkout to compare with")
    parser.add_argument("--rounds", type=int, default=15, help="turns of each (default: 15)")
    return parser


def children_processor_s() -> float:
    """Return the processor seconds of all processes that this one has started and waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def start(script: str, checkout: Path) -> subprocess.Popen[str]:
    """Start a script that serves, with the code of a checkout, on one thread."""
    return subprocess.Popen(
        [sys.executable, script, "--serve"],
        env=os.environ | {"PYTHONPATH": str(checkout.resolve()), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def ask(process: subprocess.Popen[str], case: str) -> Any:
    """Return what a process measures for a case."""
    assert process.stdin is not None
    assert process.stdout is not None
    print(json.dumps(case), file=process.stdin, flush=True)
    return json.loads(process.stdout.readline())


def end(process: subprocess.Popen[str]) -> None:
    """End a process that serves, and wait for it."""
    assert process.stdin is not None
    process.stdin.close()
    process.wait()
