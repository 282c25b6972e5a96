"""Stopping runs outside of studies."""

import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest

from armscan.runs import stop

WORK = """
import signal, time
signal.signal(signal.SIGTERM, signal.default_int_handler)
try:
    print("ready", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    raise SystemExit(130)
"""


@pytest.mark.parametrize("handler", [signal.SIG_IGN, signal.SIG_DFL], ids=["started by a script with &", "usual"])
def test_run_is_interrupted_even_if_it_ignores_ctrl_c(monkeypatch, handler):
    before = signal.signal(signal.SIGINT, handler)
    try:
        process = subprocess.Popen([sys.executable, "-c", WORK], stdout=subprocess.PIPE)
    finally:
        signal.signal(signal.SIGINT, before)
    with process:
        assert process.stdout.readline() == b"ready\n"
        note = SimpleNamespace(process=SimpleNamespace(pid=process.pid, is_here=True, is_alive=True))
        monkeypatch.setattr(stop.PendingRun, "of", lambda _: note)
        run = SimpleNamespace(info=SimpleNamespace(run_id="a", status="RUNNING"))
        assert f"its process {process.pid} was interrupted" in stop.interrupt(run)
        assert process.wait(60) == 130
