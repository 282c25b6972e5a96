"""An agent, as a command names it, brought to volumes: what `armscan.evaluate` and `armscan.watch` have in common."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch

from armscan import judging
from armscan.errors import InvalidValueError
from armscan.judging import Subject, Trial
from armscan.judging.volumes import Volumes
from armscan.mistakes import mistake_in_one_line
from armscan.request import Request
from armscan.settings import PHANTOM, usual_tracking


@dataclass(frozen=True)
class Applied:
    """An agent that is ready to play on volumes.

    Args:
        subject: the agent.
        trial: the agent in its environments.
        notes: what is to be known of it, in a sentence each.
        store: the section `tracking`.
    """

    subject: Subject
    trial: Trial
    notes: tuple[str, ...]
    store: Mapping[str, Any]


def apply(
    request: Request, check: Callable[[Mapping[str, Volumes]], None] = lambda _: None, *, render_mode: str | None = None
) -> Applied:
    """Finds the agent and the volumes that a command asks for, brings them together, and tells what is to be known.

    Args:
        request: what is asked for.
        check: raises where the volumes, by what they are called, are none that the command can do with.
        render_mode: of the environments.

    Raises:
        ArmscanError: if one is not there or damaged, or the agent cannot be applied to the volumes.
    """
    torch.set_num_threads(1)
    if request.folder and not Path(request.folder).is_dir():
        raise InvalidValueError(
            f"data is {request.data!r}, but there is no such folder: it must be a folder of volumes, or {PHANTOM}"
        )
    store = _store(request)
    if request.run is not None:
        subject = judging.subject_of_run(store["uri"], request.run, request.changes)
    else:
        subject = judging.subject_of_words(request.config_words, request.folder, request.changes)
    # Elsewhere, of an agent's own volumes only those matter that its reward is fitted to.
    parts = ("training",) if request.data else judging.PARTS
    own = cache(partial(judging.own_split, subject, parts))
    groups = judging.volume_groups(request.data, request.n_phantoms, own)
    check(groups)
    trial = judging.prepare(subject, groups, judging.TrainingVolumes(own), render_mode=render_mode)
    notes = list(trial.notes)
    if request.data and subject.run:
        notes += judging.known_volumes(subject, groups)
    if subject.run and subject.volumes is None and own.cache_info().currsize:
        notes.append("the run has not kept fingerprints of its volumes: nobody knows whether these are still the same")
    for note in notes:
        print(f"note: {note}")
    return Applied(subject, trial, tuple(notes), store)


def file_name(text: str) -> str:
    """Returns a text as a file can be named by it."""
    return re.sub(r"[^\w.\-]+", "-", text)


def answered_in_one_line(command: Callable[[Request], object], request: Request) -> None:
    """Carries out a request; a mistake in the configuration that it composes is an `InvalidValueError`."""
    try:
        command(request)
    except Exception as error:
        line = mistake_in_one_line(error, request.config_words)
        if line is None or os.environ.get("ARMSCAN_TRACEBACKS"):
            raise
        raise InvalidValueError(line) from error


def _store(request: Request) -> dict[str, Any]:
    """Returns where runs are tracked: as the configuration says, where the words say nothing else."""
    said = {"uri": request.tracking, "experiment": request.tracking_experiment}
    return usual_tracking() | {name: value for name, value in said.items() if value is not None}
