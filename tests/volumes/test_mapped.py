"""Volumes in memory-mapped files: found again as they were written, or not at all."""

import errno
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.errors import InvalidValueError
from armscan.volumes import ManipulatorAction
from armscan.volumes.mapped import MAGIC, cached_volume, limit_bytes, mapped_volume, open_mapped
from tests.conftest import make_tiny_volume
from tests.support import REPOSITORY

ABOUT = {"orientation": "LPS", "found": [1, "bones"]}
TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
# Makes a volume, but is killed while its file is half written.
KILLED = """
import os, signal, sys
from pathlib import Path
from armscan.volumes import mapped
from tests.conftest import make_tiny_volume
def write_half(file, volume, about):
    write(file, volume, about)
    file.truncate(3000)
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
write, mapped._write = mapped._write, write_half
mapped.mapped_volume(Path(sys.argv[1]), lambda: (make_tiny_volume(), None))
"""


@pytest.fixture
def volume():
    plane = ManipulatorAction((1.0 / 3.0, -0.1), (0.0, 5.0 / 7.0))
    return replace(make_tiny_volume("täny", plane), origin=(0.1, -2.0, 3.5), direction=TURNED)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cache" / "tiny.volume"


@pytest.fixture
def kept(path, volume):
    mapped_volume(path, lambda: (volume, ABOUT))
    return path.read_bytes()


def never():
    raise AssertionError("made again")


def assert_same_volume(one, other):
    np.testing.assert_array_equal(one.labels, other.labels)
    np.testing.assert_array_equal(one.direction, other.direction)
    for name in ("spacing", "name", "optimal_action", "origin", "fingerprint", "shape", "centre_mm"):
        assert getattr(one, name) == getattr(other, name)


def test_mapped_volume_is_found_as_it_was_made(path, volume):
    for make in (lambda: (volume, ABOUT), never):
        found, about = mapped_volume(path, make)
        assert_same_volume(found, volume)
        assert about == ABOUT
        assert not found.labels.flags.writeable
        assert not found.direction.flags.writeable
        assert found.labels_yxz.flags.c_contiguous
        assert type(found.labels) is np.ndarray
    assert replace(found).fingerprint == volume.fingerprint


def test_voxels_are_those_of_the_file_itself(path, volume):
    found, _ = mapped_volume(path, lambda: (volume, None))
    (mapping,) = [line for line in Path("/proc/self/maps").read_text().splitlines() if line.endswith(str(path))]
    start, end = (int(word, 16) for word in mapping.split()[0].split("-"))
    assert start < found.labels.ctypes.data < end
    assert " r--s " in mapping or " r--p " in mapping


def test_file_that_is_damaged_anywhere_is_none(path, kept):
    assert open_mapped(path) is not None
    rng = np.random.default_rng(0)
    places = [0, 5, len(MAGIC), len(MAGIC) + 63, len(MAGIC) + 64, 90, 200, 4095, 4096, len(kept) - 1]
    for place in [*places, *rng.integers(0, len(kept), 300).tolist()]:
        damaged = bytearray(kept)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        assert open_mapped(path) is None, place
    for length in (0, 1, len(MAGIC), 60, 90, 200, 4096, len(kept) - 1):
        path.write_bytes(kept[:length])
        assert open_mapped(path) is None, length
    path.write_bytes(kept + b"\0")
    assert open_mapped(path) is None
    path.write_bytes(kept)
    assert open_mapped(path) is not None


def test_damaged_file_is_replaced_by_what_is_made(path, kept, volume):
    path.write_bytes(kept[:-1] + b"\7")
    assert_same_volume(mapped_volume(path, lambda: (volume, ABOUT))[0], volume)
    assert path.read_bytes() == kept


def test_process_that_is_killed_while_writing_leaves_nothing_under_the_name(path, volume):
    ended = subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False, cwd=REPOSITORY)
    assert ended.returncode == -9
    (left,) = path.parent.glob(".*unfinished")
    assert not path.exists()
    assert_same_volume(mapped_volume(path, lambda: (volume, ABOUT))[0], volume)
    # Another process may still be writing a recent one.
    assert left.exists()
    os.utime(left, (0, 0))
    mapped_volume(path.with_name("other.volume"), lambda: (volume, ABOUT))
    assert not left.exists()


def test_many_at_once_make_a_volume_once(path, volume):
    made = []

    def make():
        made.append(time.sleep(0.2))
        return volume, ABOUT

    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda _: mapped_volume(path, make), range(4)))
    assert len(made) == 1
    for each, _ in found:
        assert_same_volume(each, volume)


def test_those_that_nobody_has_opened_for_longest_make_way(path, kept, volume, monkeypatch):
    paths = [path.with_name(f"{i}.volume") for i in range(3)]
    monkeypatch.setenv("ARMSCAN_CACHE_GIB", str(3.5 * len(kept) / 2**30))
    path.unlink()
    for i, each in enumerate(paths):
        mapped_volume(each, lambda: (volume, ABOUT))
        os.utime(each, (1000 + i, 1000 + i))
    opened, _ = mapped_volume(paths[0], never)
    mapped_volume(path, lambda: (volume, ABOUT))
    assert [each.exists() for each in (*paths, path)] == [True, False, True, True]
    monkeypatch.setenv("ARMSCAN_CACHE_GIB", "0")
    mapped_volume(paths[1], lambda: (volume, ABOUT))
    assert [each.exists() for each in (*paths, path)] == [False, True, False, False]
    # A removed file that is still mapped stays readable.
    assert_same_volume(opened, volume)


@pytest.mark.parametrize("word", ["-1", "nan", "much"])
def test_limit_is_a_number_of_gib(word, monkeypatch):
    monkeypatch.setenv("ARMSCAN_CACHE_GIB", word)
    with pytest.raises(InvalidValueError, match=f"ARMSCAN_CACHE_GIB is '{word}', but it must be a number of GiB"):
        limit_bytes()


def test_volume_that_cannot_be_kept_is_used_all_the_same(volume, caplog, capfd):
    found, about = cached_volume(Path("/dev/null/tiny.volume"), lambda: (volume, ABOUT))
    assert found is volume
    assert about == ABOUT
    assert "/dev/null: volumes cannot be kept there" in caplog.text + "".join(capfd.readouterr())


def test_volume_in_a_cache_that_may_only_be_read_is_found(path, volume, monkeypatch):
    mapped_volume(path, lambda: (volume, ABOUT))

    def refused(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "utime", refused)
    assert open_mapped(path)[1] == ABOUT
