import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numba
import pytest
from filelock import FileLock, Timeout
from numba.core.caching import IndexDataCacheFile

from armscan.utils.compilation import LOCK_FILE, PACKAGE, _DeferredSignals, cached_njit
from armscan.utils.processes import interruptions

CALLER = """
from armscan.utils.compilation import cached_njit
from armscan.callee import callee


@cached_njit()
def caller():
    return callee() + 1


print(caller(), sum(caller.stats.cache_hits.values()))
"""
CALLEE = "from armscan.utils.compilation import cached_njit\n\n\n@cached_njit()\ndef callee():\n    return {}\n"


@pytest.fixture
def called(tmp_path):
    """Return a function that sets what a compiled callee returns; it returns its compiled caller's result and hits."""
    package = tmp_path / "armscan"
    shutil.copytree(PACKAGE / "utils", package / "utils", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("__init__.py", "errors.py"):
        shutil.copy(PACKAGE / name, package / name)
    (package / "__init__.py").write_text("")
    (package / "caller.py").write_text(CALLER)
    variables = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}

    def run(returned):
        (package / "callee.py").write_text(CALLEE.format(returned))
        command = [sys.executable, "-m", "armscan.caller"]
        env = variables | {"PYTHONPATH": str(tmp_path)}
        said = subprocess.run(command, cwd=tmp_path, env=env, check=True, capture_output=True, text=True).stdout
        return tuple(map(int, said.split()))

    return run


def test_a_compiled_function_is_cached(called):
    assert called(1) == (2, 0)
    assert called(1) == (2, 1)


def test_a_compiled_function_follows_a_change_of_another_that_it_calls(called):
    assert called(1) == (2, 0)
    assert called(2) == (3, 0)


def test_the_cache_of_other_compiled_functions_stays_where_it_was():
    before = vars(numba.config)["CACHE_DIR"]

    @cached_njit()
    def three():
        return 3

    assert three() == 3
    assert vars(numba.config)["CACHE_DIR"] == before
    assert "armscan-" in three.stats.cache_path


def test_the_cache_of_a_compiled_function_is_written_by_one_process_at_a_time(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    saved = []

    def save(self, key, data):
        # Another process cannot take the lock either.
        with pytest.raises(Timeout):
            FileLock(Path(self._index_path).with_name(LOCK_FILE), timeout=0).acquire()
        saved.append(key)

    monkeypatch.setattr(IndexDataCacheFile, "save", save)

    @cached_njit()
    def four():
        return 4

    assert four() == 4
    assert len(saved) == 1


@pytest.mark.parametrize("number", interruptions())
def test_interrupt_during_compilation_is_handled_at_its_end_and_a_second_one_at_once(number):
    earlier = signal.signal(number, signal.default_int_handler)
    deferred = _DeferredSignals()
    before = signal.getsignal(number)
    for n_signals in (1, 2):
        deferred.on_start(None)
        # A function that it calls.
        deferred.on_start(None)
        signal.raise_signal(number)
        if n_signals == 2:
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(number)
        deferred.on_end(None)
        with pytest.raises(KeyboardInterrupt):
            deferred.on_end(None)
        assert signal.getsignal(number) is before
    deferred.on_start(None)
    deferred.on_end(None)
    signal.signal(number, earlier)
