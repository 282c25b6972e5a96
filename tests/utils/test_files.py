"""Files that are written whole or not at all."""

import errno
import os
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armscan.utils.files import atomic_write, check_writable, remove_unfinished, truncate_torn_line


def test_file_whose_writer_fails_stays_as_it_was(tmp_path):
    def write(file):
        file.write(b"half")
        raise RuntimeError("out of ideas")

    atomic_write(tmp_path / "a", b"whole")
    with pytest.raises(RuntimeError, match="out of ideas"):
        atomic_write(tmp_path / "a", write)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == {"a": b"whole"}


@pytest.mark.parametrize("contents", ["ü", "ü".encode(), lambda file: file.write("ü".encode())])
def test_contents_are_text_bytes_or_a_function_that_writes(tmp_path, contents):
    atomic_write(tmp_path / "a", contents)
    assert (tmp_path / "a").read_text(encoding="utf-8") == "ü"


def test_file_behind_a_link_is_replaced_with_its_mode_kept(tmp_path):
    (tmp_path / "target").write_bytes(b"old")
    (tmp_path / "target").chmod(0o640)
    (tmp_path / "link").symlink_to(tmp_path / "target")
    atomic_write(tmp_path / "link", b"new", follow_link=True)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_bytes() == b"new"
    assert (tmp_path / "target").stat().st_mode & 0o777 == 0o640


def test_link_is_replaced_and_not_the_file_that_a_stranger_lets_it_lead_to(tmp_path):
    (tmp_path / "target").write_bytes(b"old")
    (tmp_path / "target").chmod(0o600)
    for target in ("target", "missing"):
        (tmp_path / "link").unlink(missing_ok=True)
        (tmp_path / "link").symlink_to(tmp_path / target)
        atomic_write(tmp_path / "link", b"new")
        assert not (tmp_path / "link").is_symlink()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["link", "target"]
    assert (tmp_path / "target").read_bytes() == b"old"


def test_links_that_were_laid_where_a_file_is_made_first_are_not_followed(tmp_path, monkeypatch):
    names = (f".a.{os.getpid()}.unfinished", ".a.drawn.unfinished")
    for name in names:
        (tmp_path / name).symlink_to(tmp_path / "precious")
    atomic_write(tmp_path / "a", b"new")
    check_writable(tmp_path / "a")
    monkeypatch.setattr("armscan.utils.files.token_hex", lambda _: "drawn")
    with pytest.raises(FileExistsError):
        check_writable(tmp_path / "a")
    with pytest.raises(FileExistsError):
        atomic_write(tmp_path / "a", b"newer")
    assert (tmp_path / "a").read_bytes() == b"new"
    assert not (tmp_path / "precious").exists()


def test_unfinished_files_of_a_killed_writer_are_removed(tmp_path):
    program = (
        "import os, sys; from pathlib import Path; from armscan.utils.files import atomic_write\n"
        "atomic_write(Path(sys.argv[1]), lambda file: (file.write(b'half'), file.flush(), os.kill(os.getpid(), 9)))"
    )
    assert subprocess.run([sys.executable, "-c", program, tmp_path / "a"], check=False).returncode == -9
    assert len(list(tmp_path.iterdir())) == 1
    remove_unfinished(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_check_of_a_place_leaves_nothing_there(tmp_path):
    check_writable(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(IsADirectoryError):
        check_writable(tmp_path)
    with pytest.raises(FileNotFoundError):
        check_writable(tmp_path / "missing" / "a")


@given(
    lines=st.lists(st.binary(max_size=20).map(lambda line: line.replace(b"\n", b"") + b"\n")),
    torn=st.binary(max_size=20),
)
def test_torn_line_is_removed_and_no_other(tmp_path_factory, lines, torn):
    path = tmp_path_factory.mktemp("torn") / "lines"
    path.write_bytes(b"".join(lines) + torn.replace(b"\n", b""))
    truncate_torn_line(path)
    assert path.read_bytes() == b"".join(lines)


@pytest.mark.parametrize("is_hidden", [False, True], ids=["itself", "behind another"])
def test_error_of_a_full_disk_names_the_file(tmp_path, is_hidden):
    full = OSError(errno.ENOSPC, "No space left on device")

    def write(file):
        if is_hidden:
            # As libraries do when they write the end of an archive to a full disk.
            raise RuntimeError("unexpected pos") from full
        raise full

    with pytest.raises(OSError, match="No space left on device") as named:
        atomic_write(tmp_path / "a", write)
    assert named.value.filename == str(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []
