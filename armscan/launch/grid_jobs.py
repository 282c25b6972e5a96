"""Overrides of a grid, and those of each of its jobs."""

from __future__ import annotations

from collections.abc import Sequence

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override

from armscan.config.compose import config_loader


def jobs_of(overrides: Sequence[str]) -> tuple[list[Override], list[list[str]]]:
    """Return the overrides of a grid, parsed, and those of each job."""
    # Of `glob(...)`, the loader tells which choices there are.
    with config_loader() as loader:
        parsed = OverridesParser.create(config_loader=loader).parse_overrides(list(overrides))
        (jobs,) = BasicSweeper.split_arguments(parsed, max_batch_size=None)
    return parsed, jobs


def shared_overrides(parsed: Sequence[Override]) -> list[str]:
    """Return the overrides that all jobs share, as Hydra spells them for each job: `agent.lr=0.001` for `1e-3`."""
    # The last override of a key counts.
    by_key = {each.get_key_element(): each for each in parsed}
    return [f"{key}={each.get_value_element_as_str()}" for key, each in by_key.items() if not each.is_sweep_override()]
