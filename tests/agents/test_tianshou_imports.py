"""Tianshou is imported without packages that armscan does not use through it."""

from __future__ import annotations

from tests.support.programs import output_of

PROGRAM = """
import sys
from armscan.agents.tianshou_imports import import_tianshou
import_tianshou()
print(sorted({"ray", "pettingzoo", "tensorboard", "matplotlib"} & set(sys.modules)))
from matplotlib.figure import Figure
from torch.utils.tensorboard import SummaryWriter
print(Figure.__module__, SummaryWriter.__module__)
"""


def test_packages_are_not_imported_with_tianshou_and_can_be_imported_afterwards() -> None:
    """In its own process: here, other tests have imported them."""
    assert output_of(PROGRAM).splitlines() == ["[]", "matplotlib.figure torch.utils.tensorboard.writer"]
