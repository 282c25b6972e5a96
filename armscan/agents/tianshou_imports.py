"""Tianshou, imported without packages that armscan does not use through it: half a second less for each process.

The package imports this module first, so that its other modules find Tianshou imported.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any

ABSENT = {
    "tianshou.env.pettingzoo_env": "PettingZooEnv",
    "matplotlib.figure": "Figure",
    "torch.utils.tensorboard": "SummaryWriter",
    "tensorboard.backend.event_processing": "event_accumulator",
}
"""Modules that Tianshou imports for its loggers and multi-agent environments, and the name that it takes from each."""


def import_tianshou() -> None:
    """Import Tianshou, with an empty class for each name of `ABSENT`, and without Ray.

    Afterwards, the modules of `ABSENT` can be imported as usual. Those imported before are left as they are, and so is
    Tianshou itself.
    """
    # None makes an import fail: Tianshou does without Ray then.
    stand_ins: dict[str, ModuleType | None] = {"ray": None}
    for name, part in ABSENT.items():
        module = stand_ins[name] = ModuleType(name)
        setattr(module, part, type(part, (), {}))
    absent: dict[str, Any] = {name: module for name, module in stand_ins.items() if name not in sys.modules}
    sys.modules.update(absent)
    try:
        importlib.import_module("tianshou.algorithm")
    finally:
        for name in absent:
            del sys.modules[name]


import_tianshou()
