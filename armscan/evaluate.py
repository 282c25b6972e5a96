"""The command `python -m armscan.evaluate`: how good an agent is, with intervals, on any volumes.

    python -m armscan.evaluate run=ID                      a tracked run's agent, on the run's own volumes
    python -m armscan.evaluate run=ID data=FOLDER          ... on the volumes of a folder
    python -m armscan.evaluate run=ID data=phantom         ... on phantoms that no run trains on
    python -m armscan.evaluate agent=NAME projection=zy    a baseline, with any key=value of armscan.run and
                                                           experiment=PRESET; not tracking.* and evaluation.*

run=ID              the run's id, or its first four or more characters, as the UI shows them
agent=NAME          instead of run: an agent that need not be trained
data=FOLDER         volumes with their manifest; ./phantom for a folder of that name
phantoms=8          how many, with data=phantom
episodes=200        for each split, in turn on its volumes
seed=0              of the episodes; the same one gives every agent the same ones
delta=0.01          end episodes above -delta; likewise max_steps=50, start=random, clustering=metric
judged_by_sampling=true    let the policy act as it explores; device=cpu: compute there
out=FILE.json       the figures and episodes as JSON, where nothing is said in evaluations/; only such is replaced
tracking=URI        the store, MLFLOW_TRACKING_URI or sqlite:///mlruns.db where nothing is said
tracking_experiment=armscan   with agent=NAME: of MLflow, that the evaluation is tracked in; otherwise the run's

docs/evaluation.md says what the figures mean.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from armscan.checks import check_int
from armscan.errors import InvalidValueError
from armscan.files import check_writable, write_whole
from armscan.mistakes import quieten_libraries
from armscan.request import EVALUATION, Request, parse
from armscan.settings import plain
from armscan.words import answered

if TYPE_CHECKING:
    from armscan.applying import Applied
    from armscan.judging import Judgement
    from armscan.judging.volumes import Volumes

FOLDER, SUFFIX = Path("evaluations"), ".json"
# What the JSON of every evaluation holds.
KEYS_OF_A_REPORT = {"of", "name", "splits", "volumes", "episodes", "tracked_as"}


def evaluate(request: Request) -> Path:
    """Evaluates what is asked for, prints and tracks it; returns the JSON file."""
    # Deferred: a mistake on the command line should be answered before these are loaded.
    from rich.console import Console

    from armscan import judging
    from armscan.applying import apply
    from armscan.console import print_where_to_look
    from armscan.tracking import check_artifacts

    applied = apply(request, partial(_check_episodes, request.n_episodes))
    if applied.subject.run is not None:
        check_artifacts(applied.subject.run.client, applied.subject.run.experiment_id)
    _check_out(request.out)
    judgement, file = _tracked(request, applied)
    for table in judging.judgement_tables(judgement):
        Console().print(table)
    print_where_to_look(Path.cwd(), applied.store["uri"], files=(str(file),))
    return file


def _check_episodes(n_episodes: int, groups: Mapping[str, Volumes]) -> None:
    for label, volumes in groups.items():
        which = f"episodes, of which each of {len(volumes)} {label} is to have one,"
        check_int(which, n_episodes, at_least=len(volumes))


def _tracked(request: Request, applied: Applied) -> tuple[Judgement, Path]:
    """Plays, and keeps what comes of it: in a JSON file, and in a tracked run, a child of the run that is evaluated."""
    from armscan.applying import file_name
    from armscan.judging import Judgement, data_name
    from armscan.tracking import EVALUATED_TAG, TrackedRun, deliver_leftovers, open_store

    subject = applied.subject
    if subject.run is not None:
        client, experiment_id = subject.run.client, subject.run.experiment_id
    else:
        client, experiment_id = open_store(**applied.store)
    deliver_leftovers(client)
    of, data = subject.run.run_id if subject.run else subject.name, data_name(request.data)
    facts = {
        "of": of,
        "name": subject.name,
        "data": request.data or data,
        "episodes_a_split": request.n_episodes,
        "seed": request.seed,
        "changes": dict(request.changes),
        "notes": list(applied.notes),
    }
    with TrackedRun.start(
        client,
        experiment_id,
        name=f"evaluation: {subject.name} on {data}",
        config={**plain(subject.config), "evaluation": facts},
        tags={EVALUATED_TAG: of},
        folder=FOLDER,
        parent_id=subject.run.run_id if subject.run else None,
    ) as tracked:
        evaluations = applied.trial.played(request.n_episodes, request.seed, tell=partial(print, flush=True))
        # Of an agent's own volumes, those that it was trained on and those that it was not are never put together.
        judgement = Judgement(
            evaluations, has_total=request.data is not None, facts={**facts, "tracked_as": tracked.run_id}
        )
        for group, figures in judgement.metrics().items():
            named = {f"{group}/{name}": value for name, value in figures.items()}
            tracked.log_figures(named, n_env_steps=subject.n_env_steps)
        file = request.out or FOLDER / f"{file_name(f'{subject.name}-{data}')}-{tracked.run_id[:8]}.json"
        text = json.dumps(judgement.to_dict(), indent=1, allow_nan=False)
        write_whole(file, lambda opened: opened.write(text.encode()))
        tracked.log_files(file)
    return judgement, file


def _check_out(out: Path | None) -> None:
    """Writes where the JSON file will lie, before an evaluation that may take hours is played for it."""
    file = out or FOLDER / "evaluation.json"
    if file.suffix != SUFFIX:
        raise InvalidValueError(f"out is {str(file)!r}, but it must be a file whose name ends with {SUFFIX}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        check_writable(file)
        is_anothers = out is not None and file.exists() and not _is_report(file)
    except OSError as error:
        raise InvalidValueError(f"out is {str(file)!r}, but no file can be written there: {error.strerror}") from error
    if is_anothers:
        raise InvalidValueError(
            f"out is {str(file)!r}, but that file is no evaluation, and would be lost: name another"
        )


def _is_report(file: Path) -> bool:
    try:
        contents = json.loads(file.read_bytes())
    except ValueError:
        return False
    return isinstance(contents, dict) and contents.keys() >= KEYS_OF_A_REPORT


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="no figures were written")


def _run(words: Sequence[str]) -> int:
    request = parse(words, EVALUATION)
    # Deferred: a mistake on the command line should be answered before it is loaded.
    from armscan.applying import answered_in_one_line

    quieten_libraries()
    answered_in_one_line(evaluate, request)
    return 0


if __name__ == "__main__":
    sys.exit(main())
