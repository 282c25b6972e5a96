"""Atomic writes, and the folders and errors of files on disk."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import mmap
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from secrets import token_hex
from tempfile import TemporaryDirectory
from typing import BinaryIO

import platformdirs

from armscan.errors import with_causes

UNFINISHED = "unfinished"
# The disk is full, or the user's quota is.
FULL_DISK = (errno.ENOSPC, errno.EDQUOT)
# Why such a file is not opened.
NAMED_PIPE = "is a named pipe, which is never read, because that would wait for its writer"
# Names of the folders of installed packages.
PACKAGE_FOLDERS = frozenset({"site-packages", "dist-packages"})
# Prefix of the address of a database in a file.
SQLITE_PREFIX = "sqlite:///"


def cache_folder() -> Path:
    """Return the machine's cache folder for all runs: `$ARMSCAN_CACHE`, or else the user's cache folder."""
    named = os.environ.get("ARMSCAN_CACHE")
    return Path(named) if named else Path(platformdirs.user_cache_dir("armscan"))


def sqlite_file(uri: str) -> Path:
    """Return the absolute path of a database's file."""
    return Path(uri.removeprefix(SQLITE_PREFIX)).absolute()


def atomic_write(
    path: Path, contents: str | bytes | Callable[[BinaryIO], object], *, follow_link: bool = False
) -> None:
    """Write a file under a temporary name and rename it: a reader sees the old or the new one, never half of one.

    Once this has returned, neither a killed process nor a power cut loses the new one.

    Args:
        path: Path of the file, in an existing folder.
        contents: Text, written in UTF-8; bytes; or a function that writes to the open file.
        follow_link: Whether to replace the target of a link at this path, and not the link. Default: False, because an
            untrusted folder may have links to any file of this user.
    """
    path = path.resolve() if follow_link else path.parent.resolve() / path.name
    unfinished = _unfinished(path)
    try:
        with named_if_full(path):
            with unfinished.open("xb") as file:
                if callable(contents):
                    contents(file)
                else:
                    file.write(contents.encode() if isinstance(contents, str) else contents)
                file.flush()
                os.fsync(file.fileno())
            if path.exists() and not path.is_symlink():
                shutil.copymode(path, unfinished)
            unfinished.replace(path)
        _sync_folder(path.parent)
    finally:
        unfinished.unlink(missing_ok=True)


def create_database(file: Path, make: Callable[[Path], object]) -> None:
    """Create a SQLite database elsewhere and move it to its place whole, if there is no file or an empty one.

    A library cannot use tables that it was creating when the process was killed.

    Args:
        file: File of the database.
        make: Function that creates the tables in a new file, and closes it.
    """
    if not file.exists() or not file.stat().st_size:
        with TemporaryDirectory() as folder:
            made = Path(folder) / "new.db"
            make(made)
            atomic_write(file, made.read_bytes(), follow_link=True)


@contextlib.contextmanager
def named_if_full(path: Path) -> Iterator[None]:
    """Name the file in the error of a full disk, which itself names one only if opening a file raised it.

    Args:
        path: File, or folder of several files.

    Raises:
        OSError: With the path, replacing any error that a full disk caused.
    """
    try:
        yield
    except Exception as error:
        errors = (each for each in with_causes(error) if isinstance(each, OSError))
        full = next((each for each in errors if each.errno in FULL_DISK), None)
        if full is None or full.filename is not None:
            raise
        raise OSError(full.errno, full.strerror, str(path)) from error


def nearest_existing(path: Path) -> Path:
    """Return a path, or the nearest of the folders above it that exists."""
    path = path.absolute()
    return next(each for each in (path, *path.parents) if each.exists())


def check_writable(path: Path) -> None:
    """Raise the `OSError` that `atomic_write`, following links, would raise at a path; leave no file behind."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    unfinished = _unfinished(path.resolve())
    unfinished.touch(exist_ok=False)
    unfinished.unlink()


def _unfinished(path: Path) -> Path:
    # Random: in an untrusted folder, a link may lie at any name that could be predicted.
    return path.with_name(f".{path.name}.{token_hex(4)}.{UNFINISHED}")


def sha256(contents: bytes) -> str:
    """Return the SHA-256 of bytes, as 64 hexadecimal digits."""
    return hashlib.sha256(contents).hexdigest()


def _sync_folder(folder: Path) -> None:
    """Flush a folder's entries to disk, without which a file's new name may be lost."""
    # Not every system can open a folder, and not every file system can sync one; the file itself is whole either way.
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def remove_unfinished(folder: Path) -> None:
    """Remove the unfinished files of a process that was killed during a write; requires the folder's lock."""
    for file in folder.glob(f".*.{UNFINISHED}"):
        file.unlink(missing_ok=True)


def truncate_torn_line(path: Path) -> None:
    """Remove an incomplete last line, whose writer died before its end."""
    with path.open("rb+") as file:
        size = file.seek(0, os.SEEK_END)
        # An empty file cannot be mapped.
        if size > 0:
            with mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) as contents:
                end = contents.rfind(b"\n") + 1
            if end < size:
                file.truncate(end)
