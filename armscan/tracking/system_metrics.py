"""MLflow's system metrics of the machine while a run trains, uploaded like all other metrics."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Mapping
from typing import Any

# MLflow's prefix; its UI shows these metrics on a page of their own.
PREFIX = "system/"


class SystemMetrics:
    """A thread that measures CPU, memory, disk, network and GPUs at regular intervals, and once at its end.

    MLflow's own thread would read from the store and write to it each time, and end once the store is unavailable.

    Args:
        take: Function that takes the metrics by name, and the number of the measurement, which is MLflow's step.
        every_s: Seconds between two measurements.
        first: Number of the first measurement.
    """

    def __init__(self, take: Callable[[Mapping[str, float], int], None], *, every_s: float, first: int) -> None:
        self._take, self._every_s, self._number = take, every_s, first
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="system metrics", daemon=True)
        self._thread.start()

    def finish(self) -> None:
        """Measure once more, and end the thread."""
        self._is_over.set()
        self._thread.join()

    def _work(self) -> None:
        monitors, is_over = _monitors(), False
        while not is_over:
            is_over = self._is_over.wait(self._every_s)
            metrics: dict[str, float] = {}
            for monitor in monitors:
                monitor.collect_metrics()
                metrics |= {f"{PREFIX}{name}": float(value) for name, value in monitor.aggregate_metrics().items()}
                monitor.clear_metrics()
            # On a full disk the sample is left out, and the next one is taken.
            with contextlib.suppress(OSError):
                self._take(metrics, self._number)
                self._number += 1


def _monitors() -> list[Any]:
    from mlflow.system_metrics.metrics.cpu_monitor import CPUMonitor
    from mlflow.system_metrics.metrics.disk_monitor import DiskMonitor
    from mlflow.system_metrics.metrics.gpu_monitor import GPUMonitor
    from mlflow.system_metrics.metrics.network_monitor import NetworkMonitor

    kinds: tuple[type[Any], ...] = (CPUMonitor, DiskMonitor, NetworkMonitor, GPUMonitor)
    monitors = []
    for kind in kinds:
        try:
            monitor = kind()
            # Discard the first sample: the CPU load is an average since this thread's previous measurement.
            monitor.collect_metrics()
            monitor.clear_metrics()
        # Any error on a machine without this device, such as a GPU.
        except Exception:
            continue
        monitors.append(monitor)
    return monitors
