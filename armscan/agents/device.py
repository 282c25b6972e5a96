"""Where tensors live."""

from __future__ import annotations

import torch

from armscan.checks import check_choice
from armscan.errors import InvalidValueError

DEVICES = ("cpu", "cuda")


def checked_device(device: str) -> str:
    """Returns the torch device if this machine has it."""
    check_choice("device", device, DEVICES)
    if device == "cuda" and not torch.cuda.is_available():
        raise InvalidValueError("device is 'cuda', but torch finds no CUDA device here; it must be 'cpu'")
    return device
