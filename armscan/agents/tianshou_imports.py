"""Import Tianshou without the packages that armscan does not need; this saves each process half a second."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any

STUBS = {
    "matplotlib.figure": "Figure",
    "tianshou.env.pettingzoo_env": "PettingZooEnv",
    "torch.utils.tensorboard": "SummaryWriter",
    "tensorboard.backend.event_processing": "event_accumulator",
}
"""Modules that Tianshou imports for its loggers and multi-agent environments, and the name that it takes from each."""


def import_tianshou() -> None:
    """Import Tianshou, with an empty class for each name of `STUBS`, and without Ray.

    Call it before anything else imports Tianshou; afterwards it does nothing. Tianshou keeps the empty classes, so its
    logger for TensorBoard and its multi-agent environments do not work in this process. Other code that imports these
    modules gets the real ones.
    """
    # None makes the import fail, and Tianshou works without Ray.
    modules: dict[str, Any] = {"ray": None}
    for name, part in STUBS.items():
        modules[name] = ModuleType(name)
        setattr(modules[name], part, type(part, (), {}))
    added = {name: module for name, module in modules.items() if name not in sys.modules}
    sys.modules.update(added)
    try:
        importlib.import_module("tianshou.algorithm")
    finally:
        for name in added:
            del sys.modules[name]
