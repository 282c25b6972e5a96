"""Measure how long a fresh process takes to `import armscan`, and from there to its first steps.

    python -m benchmarks.speed.imports

Each figure is the best of several fresh processes, after one that has compiled everything and made the phantoms.
"""

from __future__ import annotations

import subprocess
import sys

from benchmarks.arguments import parser_of
from benchmarks.tables import print_head, print_row

N_PROCESSES = 5
IMPORT = "import time; start = time.perf_counter(); import armscan; print(time.perf_counter() - start)"
STEP = """
import time; start = time.perf_counter()
import armscan, gymnasium
env = gymnasium.make("armscan/Armscan-v0", projection="zy"{arguments})
env.reset(seed=0)
env.step(env.action_space.sample())
print(time.perf_counter() - start)
"""
PROGRAMS = {
    "`import armscan`": IMPORT,
    "from there to the first step, on the 4 default phantoms": STEP.format(arguments=""),
    "the same with slice_channels, stack and memory": STEP.format(
        arguments=', observation="slice_channels", stack=4, memory=2'
    ),
    "to the first step of 64 environments side by side": STEP.format(arguments="")
    .replace(".make(", ".make_vec(")
    .replace('zy"', 'zy", num_envs=64'),
}


def seconds(program: str) -> float:
    """Return the seconds that a fresh process prints."""
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return float(answer.stdout.split()[-1])


def main() -> None:
    """Print the table."""
    parser_of(__doc__).parse_args()
    print_head("", "seconds")
    for name, program in PROGRAMS.items():
        seconds(program)
        print_row(name, f"{min(seconds(program) for _ in range(N_PROCESSES)):.2f}")


if __name__ == "__main__":
    main()
