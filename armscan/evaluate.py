"""The command `python -m armscan.evaluate`: how good an agent is, with intervals, on any volumes.

    python -m armscan.evaluate run=ID                      a tracked run's agent, on the run's own volumes
    python -m armscan.evaluate run=ID data=FOLDER          ... on the volumes of a folder
    python -m armscan.evaluate run=ID data=phantoms        ... on phantoms that no run trains on
    python -m armscan.evaluate agent=NAME projection=zy    a baseline, with any key=value of armscan.run

run=ID              the run's id, or its first four or more characters, as the UI shows them
agent=NAME          instead of run: an agent that need not be trained
data=FOLDER         volumes with their manifest; ./phantoms for a folder of that name
phantoms=8          how many, with data=phantoms
episodes=200        for each split, in turn on its volumes
seed=0              of the episodes; the same one gives every agent the same ones
delta=0.01          end episodes above -delta; likewise max_steps=50, start=random, clustering=metric
judged_by_sampling=true    let the policy act as it explores; device=cpu: compute there
out=FILE            the figures and episodes as JSON, where nothing is said in evaluations/
tracking=URI        the store, MLFLOW_TRACKING_URI or sqlite:///mlruns.db where nothing is said
experiment=armscan  with agent=NAME: that the evaluation is tracked in; otherwise it is the run's

docs/evaluation.md says what the figures mean.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armscan.checks import check_int, check_seed
from armscan.errors import InvalidValueError
from armscan.files import write_whole
from armscan.mistakes import mistake_in_one_line, quieten_libraries
from armscan.settings import plain, usual_tracking
from armscan.words import answered, read_words

if TYPE_CHECKING:
    from armscan.judging import Judgement, Subject, Trial

CHANGES = ("delta", "max_steps", "start", "clustering", "judged_by_sampling", "device")
OWN = ("run", "data", "phantoms", "episodes", "seed", "out", "tracking", "experiment", *CHANGES)
TEXTS = ("run", "data", "start", "clustering", "device", "out", "tracking", "experiment")
PHANTOMS = "phantoms"
N_PHANTOMS, N_EPISODES = 8, 200
FOLDER = Path("evaluations")


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is to be evaluated, and how.

    Args:
        run: the id of a tracked run, None for an agent without one.
        agent_words: what the configuration of an agent without a run is composed of.
        data: a folder, `phantoms`, or None for the volumes of the agent's own configuration.
        n_phantoms: how many.
        n_episodes: for each split.
        seed: of the episodes.
        changes: rules that are changed.
        out: the JSON file, None for one of its own in `evaluations`.
        tracking: of the store, None for the usual one.
        experiment: likewise.
    """

    run: str | None = None
    agent_words: tuple[str, ...] = ()
    data: str | None = None
    n_phantoms: int = N_PHANTOMS
    n_episodes: int = N_EPISODES
    seed: int = 0
    changes: Mapping[str, Any] = field(default_factory=dict)
    out: Path | None = None
    tracking: str | None = None
    experiment: str | None = None


def parse(words: Sequence[str]) -> Request:
    """Returns what `key=value` words ask for.

    Raises:
        InvalidValueError: if a word is something else, a key unknown, or a value of another kind.
    """
    keys = [word.partition("=")[0] for word in words]
    with_agent = "agent" in keys
    # Beside an agent without a run, whatever is not this command's own is of the configuration.
    others = [word for word, key in zip(words, keys, strict=True) if with_agent and key not in OWN]
    values = read_words([word for word in words if word not in others], ("run", "agent", *OWN[1:]), TEXTS)
    if with_agent and "run" in values:
        raise InvalidValueError("run and agent are both given, but a run has its agent: give one of them")
    if not with_agent and "run" not in values:
        raise InvalidValueError("run is not set, but it must be: give run=ID, or agent=NAME (--help explains)")
    if "phantoms" in values and values.get("data") != PHANTOMS:
        raise InvalidValueError(f"phantoms is {values['phantoms']!r}, but it is for data={PHANTOMS}")
    if "experiment" in values and not with_agent:
        raise InvalidValueError("experiment is for agent=NAME: the evaluation of a run is tracked in the run's own")
    return Request(
        run=values.get("run"),
        agent_words=tuple(others),
        data=values.get("data"),
        n_phantoms=check_int("phantoms", values.get("phantoms", N_PHANTOMS), at_least=1, at_most=10_000),
        n_episodes=check_int("episodes", values.get("episodes", N_EPISODES), at_least=1),
        seed=check_seed("seed", values.get("seed", 0)),
        changes={name: values[name] for name in CHANGES if name in values},
        out=Path(values["out"]) if "out" in values else None,
        tracking=values.get("tracking"),
        experiment=values.get("experiment"),
    )


def evaluate(request: Request) -> Path:
    """Evaluates what is asked for, prints and tracks it; returns the JSON file."""
    # Deferred: a mistake on the command line should be answered before these are loaded.
    import torch
    from rich.console import Console

    from armscan import judging
    from armscan.console import print_where_to_look

    torch.set_num_threads(1)
    store = _store(request)
    if request.run is not None:
        subject = judging.subject_of_run(store["uri"], request.run, request.changes)
    else:
        folder = None if request.data == PHANTOMS else request.data
        subject = judging.subject_of_words(request.agent_words, folder, request.changes)
    # Elsewhere, of an agent's own volumes only those matter that its reward is fitted to.
    parts = ("training",) if request.data else judging.PARTS
    own = cache(partial(judging.own_split, subject, parts))
    groups = judging.volume_groups(request.data, request.n_phantoms, own)
    for label, volumes in groups.items():
        check_int(
            f"episodes, of which each of {len(volumes)} {label} is to have one,",
            request.n_episodes,
            at_least=len(volumes),
        )
    trial = judging.prepare(subject, groups, judging.TrainingVolumes(own))
    notes = list(trial.notes)
    if request.data and subject.run:
        notes += judging.known_volumes(subject, groups)
    if subject.run and subject.volumes is None and own.cache_info().currsize:
        notes.append("the run has not kept fingerprints of its volumes: nobody knows whether these are still the same")
    for note in notes:
        print(f"note: {note}")
    _check_out(request.out or FOLDER / "evaluation.json")
    judgement, file = _tracked(request, subject, trial, notes, store)
    for table in judging.judgement_tables(judgement):
        Console().print(table)
    print_where_to_look(Path.cwd(), store["uri"], files=(str(file),))
    return file


def _tracked(
    request: Request, subject: Subject, trial: Trial, notes: Sequence[str], store: Mapping[str, str]
) -> tuple[Judgement, Path]:
    """Plays, and keeps what comes of it: in a JSON file, and in a tracked run, a child of the run that is evaluated."""
    from armscan.judging import Judgement, data_name
    from armscan.tracking import EVALUATED_TAG, TrackedRun, open_store

    if subject.run is not None:
        client, experiment_id = subject.run.client, subject.run.experiment_id
    else:
        client, experiment_id = open_store(**store)
    of, data = subject.run.run_id if subject.run else subject.name, data_name(request.data)
    facts = {
        "of": of,
        "name": subject.name,
        "data": request.data or data,
        "episodes_a_split": request.n_episodes,
        "seed": request.seed,
        "changes": dict(request.changes),
        "notes": list(notes),
    }
    with TrackedRun.start(
        client,
        experiment_id,
        name=f"evaluation: {subject.name} on {data}",
        config={**plain(subject.config), "evaluation": facts},
        tags={EVALUATED_TAG: of},
        parent_id=subject.run.run_id if subject.run else None,
    ) as tracked:
        evaluations = trial.played(request.n_episodes, request.seed, tell=partial(print, flush=True))
        # Of an agent's own volumes, those that it was trained on and those that it was not are never put together.
        judgement = Judgement(
            evaluations, has_total=request.data is not None, facts={**facts, "tracked_as": tracked.run_id}
        )
        for group, figures in judgement.metrics().items():
            named = {f"{group}/{name}": value for name, value in figures.items()}
            tracked.log_figures(named, n_env_steps=subject.n_env_steps)
        file = request.out or FOLDER / f"{_file_name(f'{subject.name}-{data}')}-{tracked.run_id[:8]}.json"
        text = json.dumps(judgement.to_dict(), indent=1, allow_nan=False)
        write_whole(file, lambda opened: opened.write(text.encode()))
        tracked.log_files(file)
    return judgement, file


def _store(request: Request) -> dict[str, str]:
    """Returns where runs are tracked: as the configuration says, where the words say nothing else."""
    said = {"uri": request.tracking, "experiment": request.experiment}
    return usual_tracking() | {name: value for name, value in said.items() if value is not None}


def _check_out(file: Path) -> None:
    """Makes the folder of the JSON file, before an evaluation that may take hours is played for it."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidValueError(f"out is {str(file)!r}, but no file can be written there: {error.strerror}") from error
    if file.is_dir() or not os.access(file.parent, os.W_OK):
        raise InvalidValueError(f"out is {str(file)!r}, but no file can be written there")


def _file_name(text: str) -> str:
    return re.sub(r"[^\w.\-]+", "-", text)


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="no figures were written")


def _run(words: Sequence[str]) -> int:
    quieten_libraries()
    try:
        evaluate(parse(words))
    except Exception as error:
        line = mistake_in_one_line(error)
        if line is None or os.environ.get("ARMSCAN_TRACEBACKS"):
            raise
        raise InvalidValueError(line) from error
    return 0


if __name__ == "__main__":
    sys.exit(main())
