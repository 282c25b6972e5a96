"""The phases of a study: first its configurations are searched, then the best of them are judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optuna.trial import Trial

from armscan.sweeps.ledger import Ledger
from armscan.sweeps.space import Space
from armscan.tracking import TrackingStore

if TYPE_CHECKING:
    from armscan.sweeps.attempt import Attempt


@dataclass(frozen=True, kw_only=True)
class Phase:
    """What the trials of one phase have in common.

    Args:
        name: of its study in the storage.
        ledger: its books.
        space: what is searched.
        objectives: the figures that are told, in their order.
        reported: that which is reported while a trial runs; None where nobody prunes by it.
        run: runs an attempt at a trial and returns its figures.
        seeds_of: the seeds that a trial is run with.
        sampler: see `StudySettings`.
        seed: of the samplers.
        folder: of the trials.
        artifacts: see `StudySettings`.
        storage_uri: of the storage, as it may be shown.
        client: of the tracking store.
        experiment_id: of the tracked runs.
        run_id: of the study's tracked run.
    """

    name: str
    ledger: Ledger
    space: Space
    objectives: tuple[str, ...]
    reported: str | None
    run: Callable[[Attempt], dict[str, float]]
    seeds_of: Callable[[Trial], tuple[int, ...]]
    sampler: Mapping[str, Any]
    seed: int
    folder: Path
    artifacts: Path
    storage_uri: str
    client: TrackingStore
    experiment_id: str
    run_id: str
