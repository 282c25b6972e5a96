"""An agent brought to volumes, ready to be evaluated or recorded."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial

import torch

from armscan.evaluation.agent_source import TrainedAgent
from armscan.evaluation.runner import AgentEvaluator, prepare
from armscan.evaluation.volumes import TrainingVolumes, Volumes, known_volumes, own_split, volume_groups
from armscan.training import PARTS


@dataclass(frozen=True)
class AppliedAgent:
    """An agent that is ready to play on volumes.

    Args:
        subject: the agent.
        evaluator: the agent in its environments.
        data: the folder of the volumes, `phantom`, or None for the volumes of the agent's own configuration.
        notes: what differs from its training, a sentence each.
    """

    subject: TrainedAgent
    evaluator: AgentEvaluator
    data: str | None
    notes: tuple[str, ...]


def apply(
    subject: TrainedAgent,
    data: str | None,
    n_phantoms: int,
    *,
    check: Callable[[Mapping[str, Volumes]], None] = lambda _: None,
    render_mode: str | None = None,
) -> AppliedAgent:
    """Bring an agent to volumes, and print what differs from its training.

    Args:
        subject: the agent.
        data: a folder of volumes, `phantom`, or None for the volumes of the agent's own configuration.
        n_phantoms: number of phantoms, at least 1; used for `phantom` only.
        check: raises an error if the volumes, by their labels, do not suit the caller.
        render_mode: Gymnasium render mode of the environments; default: None.

    Raises:
        ArmscanError: if volumes are missing or damaged, or the agent cannot be applied to them.
    """
    torch.set_num_threads(1)
    # Elsewhere, of an agent's own volumes only those matter that its reward is fitted to.
    parts = ("training",) if data else PARTS
    own = cache(partial(own_split, subject, parts))
    groups = volume_groups(data, n_phantoms, own)
    check(groups)
    evaluator = prepare(subject, groups, TrainingVolumes(own), render_mode=render_mode)
    notes = list(evaluator.notes)
    if data and subject.run:
        notes += known_volumes(subject, groups)
    if subject.run and subject.volumes is None and own.cache_info().currsize:
        notes.append("the run has not kept fingerprints of its volumes: nobody knows whether these are still the same")
    for note in notes:
        print(f"note: {note}")
    return AppliedAgent(subject, evaluator, data, tuple(notes))


def file_name(text: str) -> str:
    """Return a text as a file can be named by it."""
    return re.sub(r"[^\w.\-]+", "-", text)
