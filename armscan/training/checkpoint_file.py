"""Checkpoints: written whole or not at all, verified on reading, read without running code from the file.

A file is one line, `armscan checkpoint FORMAT SHA-256`, followed by the output of `torch.save`, whose SHA-256 it is.
"""

from __future__ import annotations

import hashlib
import io
import re
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from armscan.errors import CheckpointError
from armscan.utils.files import NAMED_PIPE, atomic_write

if TYPE_CHECKING:
    import torch

FORMAT = 1
MAGIC = b"armscan checkpoint "
HEADER = re.compile(MAGIC + rb"([0-9]{1,9}) ([0-9a-f]{64})\n")


def save_checkpoint(path: Path, state: dict[str, Any], facts: dict[str, Any]) -> None:
    """Write a checkpoint; a reader sees the old one or the new one, never half of one.

    Args:
        path: File to write.
        state: State of the learner.
        facts: Numbers and strings to keep beside the state, such as the number of steps.
    """
    import torch

    def write(file: BinaryIO) -> None:
        # Computed from the written file, so that a large replay buffer is not in memory twice.
        start = file.write(_header("0" * 64))
        torch.save({"state": state, "facts": facts}, file)
        file.flush()
        with Path(file.name).open("rb") as written:
            written.seek(start)
            digest = hashlib.file_digest(written, "sha256")
        file.seek(0)
        file.write(_header(digest.hexdigest()))

    atomic_write(path, write)


def load_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a checkpoint.

    Returns:
        The learner's state, and the facts beside it.

    Raises:
        CheckpointError: If the file is missing, damaged, written by a newer armscan, or not a checkpoint.
    """
    import torch

    if path.is_fifo():
        raise CheckpointError(f"{path}: {NAMED_PIPE}")
    try:
        with path.open("rb") as file:
            contents = _verified(file, path)
            _check_uncompressed(contents, path)
            loaded = torch.load(contents, map_location="cpu", weights_only=True)
            return dict(loaded["state"]), dict(loaded["facts"])
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: there is no such checkpoint") from error
    except (CheckpointError, MemoryError):
        raise
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from error
    # The checksum matches, so the file is not damaged; torch's readers raise exceptions of many types.
    except Exception as error:
        raise CheckpointError(
            f"{path}: is not a checkpoint: it contains something other than tensors, numbers and strings"
        ) from error


def load_weights(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a checkpoint that holds weights alone, as `best.pt` does.

    Returns:
        The weights by name, and the facts beside them.

    Raises:
        CheckpointError: As `load_checkpoint` does, or if it holds something else, or weights that are not finite.
    """
    import torch

    weights, facts = load_checkpoint(path)
    if "reports" in facts:
        raise CheckpointError(f"{path}: holds a full training state, as last.pt does, not the best weights")
    for name, weight in weights.items():
        if not isinstance(name, str):
            raise CheckpointError(f"{path}: names weights by an {type(name).__name__}, but names must be strings")
        if isinstance(weight, torch.Tensor):
            if not _is_dense(weight):
                raise CheckpointError(f"{path}: holds weights that are no dense tensor of its own, in {name}")
            if not torch.isfinite(weight).all():
                raise CheckpointError(f"{path}: holds weights that are not finite, in {name}")
    return weights, facts


def _is_dense(weight: torch.Tensor) -> bool:
    """Return whether a tensor holds usual numbers, and takes no memory that its file does not."""
    import torch

    floats = torch.float16, torch.bfloat16, torch.float32, torch.float64
    # Such as masks and counts in the networks of users.
    others = torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64
    is_usual = weight.dtype in (*floats, *others)
    is_strided = weight.layout == torch.strided and weight.device.type == "cpu" and not weight.is_nested
    return is_usual and is_strided and weight.nbytes <= weight.untyped_storage().nbytes()


def _header(digest: str) -> bytes:
    return MAGIC + f"{FORMAT} {digest}\n".encode()


def _verified(file: io.BufferedReader, path: Path) -> BinaryIO:
    """Return the contents after the first line, after verifying them against its SHA-256."""
    header = file.readline(len(_header("0" * 64)) + 8)
    if (match := HEADER.fullmatch(header)) is None:
        if not header:
            raise CheckpointError(f"{path}: is empty, but it must be a checkpoint")
        if header.startswith(MAGIC):
            raise CheckpointError(f"{path}: is damaged: its first line is {header!r}")
        raise CheckpointError(f"{path}: is not a checkpoint of armscan, or is damaged: it begins with {header[:16]!r}")
    if int(match[1]) != FORMAT:
        newer = "it was written by a newer version" if int(match[1]) > FORMAT else "there never was such a format"
        raise CheckpointError(
            f"{path}: is a checkpoint of format {int(match[1])}, but this version of armscan reads {FORMAT}: {newer}"
        )
    if hashlib.file_digest(file, "sha256").hexdigest().encode() != match[2]:
        raise CheckpointError(f"{path}: is damaged: its contents are not those that were written")
    return cast(BinaryIO, _OffsetFile(file, len(header)))


def _check_uncompressed(contents: BinaryIO, path: Path) -> None:
    """Raise `CheckpointError` if an archive takes more memory than space in the file, as torch never writes it."""
    size = contents.seek(0, io.SEEK_END)
    with zipfile.ZipFile(contents) as archive:
        entries, comment = archive.infolist(), archive.comment
    # torch reads the directory that the end of the archive points to, and `zipfile` the one before its end: with files
    # from the first byte on and no comment, they are the same.
    is_plain = not comment and min((each.header_offset for each in entries), default=1) == 0
    n_bytes = sum(each.file_size for each in entries)
    if n_bytes > size or not is_plain:
        raise CheckpointError(f"{path}: is not a checkpoint: its archive of {size} bytes is not as torch writes it")
    contents.seek(0)


class _OffsetFile(io.RawIOBase):
    """An open file from an offset on, as if it began there; torch counts positions from a file's beginning."""

    def __init__(self, file: io.BufferedReader, offset: int) -> None:
        super().__init__()
        self._file, self._offset = file, offset
        file.seek(offset)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        return self._file.readinto(buffer)

    def tell(self) -> int:
        return self._file.tell() - self._offset

    def seek(self, place: int, whence: int = io.SEEK_SET) -> int:
        return self._file.seek(place + (self._offset if whence == io.SEEK_SET else 0), whence) - self._offset
