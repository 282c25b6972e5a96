"""Measure the time that tracking adds to a training.

    python -m benchmarks.speed.tracking [--rounds 3] [--env-steps 20000] [--every 1000]

The default run, never stopped early, trains with the same seed, and so takes the same steps: untracked, in SQLite, on
an MLflow server, and on one that stops after the run has begun; in turn, in one process. Tracking takes time in two
ways: training waits for its own calls (`calls`), and background threads (upload, system metrics) compute while it
cannot, at worst for all of their processor time (`threads`). Their sum over the training's wall time is an upper bound
of the cost. The longest call is the longest single wait.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from armscan.config.compose import compose_run
from armscan.config.defaults import to_plain
from armscan.experiment.build import set_up
from armscan.experiment.runner import train_agent
from armscan.tracking import TrackedRun, open_store
from armscan.training import EpochReport
from armscan.utils.log import silence_libraries
from benchmarks.arguments import count, parser_of
from benchmarks.tables import print_head, print_row
from tests.support.mlflow_server import MlflowServer, mlflow_server

THREADS = ("uploader", "pending", "system metrics")
POLL_S = 0.05


class Cost(NamedTuple):
    """Times of a training.

    Args:
        wall_s: Seconds of the whole training.
        calls_s: Seconds in calls to tracking.
        longest_s: Seconds of the longest call.
        threads_s: Processor seconds of tracking's threads during the training.
    """

    wall_s: float
    calls_s: float
    longest_s: float
    threads_s: float

    @property
    def share(self) -> float:
        """Upper bound of tracking's share of the training's time."""
        return (self.calls_s + self.threads_s) / self.wall_s


class Timed:
    """A training callback that times another one."""

    def __init__(self, callback: TrackedRun) -> None:
        self._callback, self.calls_s = callback, []

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Time it."""
        self._timed(lambda: self._callback.on_start(total_env_steps, earlier))

    def on_epoch(self, report: EpochReport) -> None:
        """Time it."""
        self._timed(lambda: self._callback.on_epoch(report))

    def on_end(self) -> None:
        """Time it."""
        self._timed(self._callback.on_end)

    def _timed(self, call: Callable[[], None]) -> None:
        start_s = time.perf_counter()
        call()
        self.calls_s.append(time.perf_counter() - start_s)


class ThreadClock(threading.Thread):
    """Polls the processor time of tracking's threads, which can't be read once a thread has ended."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._over, self._seen = threading.Event(), {}

    def run(self) -> None:
        """Poll until `computed_s` is called."""
        process = psutil.Process()
        while not self._over.wait(POLL_S):
            ours = {each.native_id for each in threading.enumerate() if each.name in THREADS}
            self._seen |= {each.id: each.user_time + each.system_time for each in process.threads() if each.id in ours}

    def computed_s(self) -> float:
        """Stop polling; return the processor seconds of all threads seen."""
        self._over.set()
        self.join()
        return sum(self._seen.values())


def trained(config: Any, tracking: dict[str, Any] | None, before: Callable[[], None] = lambda: None) -> Cost:
    """Train once and return the times; `before` is called when the run has begun."""
    setup = set_up(config)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        callbacks, clock = [], ThreadClock()
        if tracking is not None:
            store, experiment_id = open_store(**tracking)
            tracked = TrackedRun.start(
                store, experiment_id, name="measured", config=to_plain(config), tags={}, folder=Path(folder)
            )
            stack.callback(tracked.end, "FINISHED", wait_s=2.0)
            callbacks = [Timed(tracked)]
        before()
        clock.start()
        start_s = time.perf_counter()
        train_agent(setup, Path(folder), callbacks, run_id="measured", tell=print)
        wall_s, threads_s = time.perf_counter() - start_s, clock.computed_s()
        calls_s = callbacks[0].calls_s if callbacks else [0.0]
        return Cost(wall_s, sum(calls_s), max(calls_s), threads_s)


@contextmanager
def ways(folder: Path) -> Iterator[dict[str, Callable[[Any], Cost]]]:
    """Yield the ways of tracking that are compared, by name."""

    def section(uri: str) -> dict[str, Any]:
        return {
            "uri": uri,
            "experiment": "measured",
            "artifacts": str(folder / "mlartifacts"),
            "wait_s": 60.0,
            "system_metrics_s": 10.0,
        }

    def away(config: Any, server: MlflowServer) -> Cost:
        server.start()
        try:
            return trained(config, section(server.uri), server.stop)
        finally:
            server.stop()

    with mlflow_server(folder / "server", f"sqlite:///{folder}/server.db") as server:
        leaving = MlflowServer(folder / "leaving", f"sqlite:///{folder}/leaving.db")
        yield {
            "untracked": lambda config: trained(config, None),
            "SQLite": lambda config: trained(config, section(f"sqlite:///{folder}/runs.db")),
            "server": lambda config: trained(config, section(server.uri)),
            "server gone": lambda config: away(config, leaving),
        }


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    for option, default in (("--rounds", 3), ("--env-steps", 20_000), ("--every", 1000)):
        parser.add_argument(option, type=count, default=default, help="default: %(default)s")
    given = parser.parse_args()
    silence_libraries()
    config, _ = compose_run(
        [
            f"training.env_steps={given.env_steps}",
            f"training.eval_every_env_steps={given.every}",
            "training.solved=null",
        ]
    )
    with tempfile.TemporaryDirectory() as folder, ways(Path(folder)) as compared:
        # The first training of a process loads and compiles.
        trained(config, None)
        costs: dict[str, list[Cost]] = {name: [] for name in compared}
        for number in range(given.rounds):
            for name, measure in compared.items():
                costs[name].append(measure(config))
                print(f"round {number}, {name}: {costs[name][-1]}", flush=True)
    print_head("tracked", "wall, s", "calls, s", "threads, s", "share, at most", "longest call, ms")
    for name, of_name in costs.items():
        wall, calls, threads, share = (
            statistics.median(getattr(cost, field) for cost in of_name)
            for field in ("wall_s", "calls_s", "threads_s", "share")
        )
        longest_ms = 1000 * max(cost.longest_s for cost in of_name)
        print_row(name, f"{wall:.1f}", f"{calls:.3f}", f"{threads:.2f}", f"{100 * share:.1f} %", f"{longest_ms:.1f}")


if __name__ == "__main__":
    main()
