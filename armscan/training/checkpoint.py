"""Checkpoints: written whole or not at all, read without running code from the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from armscan.errors import CheckpointError
from armscan.files import write_whole


def save_checkpoint(path: Path, state: dict[str, Any], facts: dict[str, Any]) -> None:
    """Writes a checkpoint; a reader sees the old one or the new one, never half of one.

    Args:
        path: the file.
        state: of the learner.
        facts: numbers and texts about it, such as how many steps it has taken.
    """
    write_whole(path, lambda file: torch.save({"state": state, "facts": facts}, file))


def load_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Reads a checkpoint.

    Returns:
        The learner's state, and the facts beside it.

    Raises:
        CheckpointError: if the file is missing, damaged, or something else.
    """
    try:
        loaded = torch.load(path, map_location="cpu", weights_only=True)
        return loaded["state"], loaded["facts"]
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: there is no such checkpoint") from error
    # torch reports a damaged file by whichever of its readers meets the damage first.
    except Exception as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise CheckpointError(f"{path}: is no checkpoint, or damaged ({reason})") from error
