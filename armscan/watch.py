"""The command `python -m armscan.watch`: films an agent, as a GIF and an MP4.

    python -m armscan.watch run=ID                      a tracked run's agent, on the run's own test volumes
    python -m armscan.watch run=ID data=FOLDER          ... on the volumes of a folder
    python -m armscan.watch run=ID data=phantom         ... on phantoms that no run trains on
    python -m armscan.watch agent=NAME projection=zy    a baseline, with any key=value of armscan.run and
                                                        experiment=PRESET; not tracking.* and evaluation.*

run=ID              the run's id, or its first four or more characters, as the UI shows them
agent=NAME          instead of run: an agent that need not be trained
data=FOLDER         volumes with their manifest; ./phantom for a folder of that name
phantoms=8          how many, with data=phantom
episodes=3          for each split, in turn on its volumes; one after another in the film
seed=0              of the episodes: those that armscan.evaluate plays with the same one
delta=0.01          end episodes above -delta; likewise max_steps=50, start=random, clustering=metric
judged_by_sampling=true    let the policy act as it explores; device=cpu: compute there
out=FOLDER          takes the files, NAME.gif and NAME.mp4; films where nothing is said
tracking=URI        the store, MLFLOW_TRACKING_URI or sqlite:///mlruns.db where nothing is said

Nothing is tracked. docs/seeing.md says what is seen.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from armscan.errors import InvalidValueError
from armscan.files import check_writable, write_whole
from armscan.mistakes import quieten_libraries
from armscan.request import FILM, Request, parse
from armscan.words import answered

if TYPE_CHECKING:
    from armscan.applying import Applied

FOLDER = Path("films")
SUFFIXES = (".gif", ".mp4")


def watch(request: Request) -> list[Path]:
    """Films what is asked for and prints how each episode went; returns the files."""
    # Deferred: a mistake on the command line should be answered before these are loaded.
    from armscan.applying import apply, file_name
    from armscan.console import from_here
    from armscan.judging import data_name

    applied = apply(request, render_mode="rgb_array")
    folder = request.out or FOLDER
    _check_out(folder)
    subject = applied.subject
    which = [subject.run.run_id[:8]] if subject.run else []
    name = file_name("-".join([subject.name, data_name(request.data), *which, f"seed{request.seed}"]))
    files = [folder / f"{name}{suffix}" for suffix in SUFFIXES]
    with tempfile.TemporaryDirectory() as made_in:
        made = [Path(made_in) / f"film{suffix}" for suffix in SUFFIXES]
        _shoot(request, applied, *made)
        for there, file in zip(made, files, strict=True):
            with there.open("rb") as contents:
                write_whole(file, partial(shutil.copyfileobj, contents))
    for file in files:
        print(f"look at   {from_here(file)}")
    return files


def _shoot(request: Request, applied: Applied, gif: Path, mp4: Path) -> None:
    """Plays the episodes that an evaluation with the same seed would play, one after another."""
    from armscan.judging.trial import FIRST_SEED
    from armscan.training import TEST, Film, outcome

    envs = applied.trial.envs
    # Of an agent's own volumes, those that it has never met.
    shown = envs if request.data else {TEST: envs[TEST]}
    with Film(gif, mp4) as film:
        for label, env in shown.items():
            names = list(env.get_wrapper_attr("volumes"))
            for number in range(request.n_episodes):
                name, seed = names[number % len(names)], request.seed + number
                agent, title = applied.trial.agent, f"seed {seed}"
                episode = film.shoot(agent, env, volume_name=name, seed=FIRST_SEED + seed, title=title)
                print(f"{label}: {name}, {title}: {outcome(episode)}", flush=True)


def _check_out(folder: Path) -> None:
    """Writes where the films will lie, before an agent plays for them."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder / "film")
    except OSError as error:
        raise InvalidValueError(
            f"out is {str(folder)!r}, but no films can be written there: {error.strerror}"
        ) from error


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="no film was written")


def _run(words: Sequence[str]) -> int:
    request = parse(words, FILM)
    # Deferred: a mistake on the command line should be answered before it is loaded.
    from armscan.applying import answered_in_one_line

    quieten_libraries()
    answered_in_one_line(watch, request)
    return 0


if __name__ == "__main__":
    sys.exit(main())
