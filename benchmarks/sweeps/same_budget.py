"""Compare the configurations that armscan and Hydra's Optuna sweeper find with the same processor time.

    python -m benchmarks.sweeps same-budget [--folder FOLDER] [--tasks sac_y sac_zy] [--first 0] [--replicates 4]
                                            [--seeds 8]

In each replicate, both search once. The replicate's number is the seed of both samplers, and determines the seeds of
its trainings. Both sides have the same space, presets, training seeds and objective, and train one trial at a time
(`benchmarks.sweeps.searches`):

- armscan: a study with its default sampler, pruner and selection. The search gets half of the budget, the race the
  rest: with the default settings, a pruned search of 40 trials and the race take equally long. The longest race with
  complete rounds decides.
- Hydra's Optuna sweeper: its default sampler. The trial with the best value is the result.

A trial starts while budget is left, and always runs to its end. Both results and the default configuration are then
trained with new seeds, and compared by the objective on the test volumes. Each outcome is a line of `results.jsonl`:
the same command continues after an interruption, and repeats only the search that was cut off. Several processes may
share the folder if their replicates or tasks differ. `--replicates 0` prints the table of all results so far.
"""

from __future__ import annotations

import contextlib
import functools
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np

from armscan.errors import InvalidValueError
from armscan.stats.paired import paired_difference
from armscan.utils.arrays import FloatArray
from armscan.utils.log import silence_libraries
from benchmarks.sweeps.bench.collect import train_and_evaluate
from benchmarks.sweeps.bench.report import markdown, with_interval
from benchmarks.sweeps.bench.table import TEST
from benchmarks.sweeps.searches import NAME, WITHOUT_END, SearchResult, search_by_armscan, search_by_hydra


class Task(NamedTuple):
    """A sweep, the number of seeds of its trials, and the processor seconds of a search: some 20 whole trainings."""

    words: tuple[str, ...]
    n_seeds: int
    budget_s: float


TASKS = {
    "sac_y": Task(("sweep=sac_y",), 1, 250.0),
    "sac_zy": Task(("sweep=sac_zy",), 2, 600.0),
}
ARMSCAN, HYDRA, DEFAULT = "armscan", "hydra", "default"
Search = Callable[[Sequence[str], float, Path], SearchResult]
SEARCHES: dict[str, Search] = {ARMSCAN: search_by_armscan, HYDRA: search_by_hydra}
# First seed of the comparison; seeds of searches begin at 0, seeds of races 1000 above. Ten successive seeds belong to
# a replicate, and ten more a thousand further on.
FIRST_SEED, SEEDS_APART, TENS_APART = 5000, 10, 1000
MAX_REPLICATES = TENS_APART // SEEDS_APART
OBJECTIVE = "mean_steps"
SHORT = ("training.env_steps=3000", "training.eval_every_env_steps=1000")
Row = dict[str, Any]


class Results:
    """Results in a file, a line of JSON each."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self.rows: list[Row] = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []

    def find(self, **known: Any) -> Row | None:
        """Return the first row with these cells."""
        return next((row for row in self.rows if known.items() <= row.items()), None)

    def add(self, **row: Any) -> Row:
        """Append a row."""
        with self._file.open("a") as file:
            file.write(json.dumps(row) + "\n")
        self.rows.append(row)
        return row


def same_budget(
    folder: Path, *, tasks: Sequence[str] = tuple(TASKS), first: int = 0, replicates: int = 4, seeds: int = 8
) -> None:
    """Run the missing searches and trainings, and print the table after each replicate.

    Args:
        folder: Folder of the results.
        tasks: Names of the tasks. Default: all.
        first: Number of the first replicate, from 0. Default: 0.
        replicates: Number of replicates. Default: 4.
        seeds: Number of seeds of each configuration on the test volumes. Default: 8.
    """
    if unknown := [name for name in tasks if name not in TASKS]:
        raise InvalidValueError(f"--tasks: {unknown[0]!r} is none of {', '.join(TASKS)}")
    if first + replicates > MAX_REPLICATES:
        raise InvalidValueError(
            f"--first is {first} and --replicates {replicates}, but only {MAX_REPLICATES} have seeds of their own"
        )
    silence_libraries()
    results = Results(folder / "results.jsonl")
    if not replicates and not results.rows:
        raise InvalidValueError(f"{folder} has no results.jsonl: give the folder of a comparison, or --replicates N")
    with contextlib.chdir(folder):
        for replicate in range(first, first + replicates):
            for name in tasks:
                _replicate(results, name, replicate, seeds)
            print(table(results.rows), flush=True)
    if not replicates:
        print(table(results.rows))


def _replicate(results: Results, name: str, replicate: int, n_seeds: int) -> None:
    task, known = TASKS[name], {"task": name, "replicate": replicate}
    # They take turns in searching first.
    for side in (ARMSCAN, HYDRA) if replicate % 2 else (HYDRA, ARMSCAN):
        if results.find(side=side, **known) is None:
            _warm_up(name)
            result = _search(side, task, replicate, Path(f"{name}-{replicate}"))
            print(name, replicate, side, result, flush=True)
            results.add(**known, side=side, **asdict(result))
    best = {DEFAULT: {}, **{side: results.find(side=side, **known)["values"] for side in SEARCHES}}
    for place in range(n_seeds):
        tens, ones = divmod(place, SEEDS_APART)
        seed = FIRST_SEED + TENS_APART * tens + SEEDS_APART * replicate + ones
        for values in best.values():
            if results.find(task=name, values=values, seed=seed) is None:
                _, evaluations = train_and_evaluate(task.words, values, seed)
                of_volumes = evaluations[TEST].by_volume()
                scores = {volume: round(each.metrics()[OBJECTIVE], 6) for volume, each in of_volumes.items()}
                results.add(**known, values=values, seed=seed, scores=scores)


@functools.cache
def _warm_up(name: str) -> None:
    """Train a short trial: the first one of a process imports and compiles."""
    task = TASKS[name]
    short = task._replace(words=(*task.words, *SHORT), budget_s=0.1)
    with tempfile.TemporaryDirectory(dir=".") as folder:
        _search(ARMSCAN, short, 0, Path(folder) / name)


def _search(side: str, task: Task, replicate: int, folder: Path) -> SearchResult:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    places = (f"study.storage={folder}/optuna.journal", f"study.folder={folder}", f"study.artifacts={folder}/artifacts")
    seeds = [SEEDS_APART * replicate + each for each in range(task.n_seeds)]
    words = [*task.words, *places, f"study.name={NAME}", f"study.n_trials={WITHOUT_END}"]
    return SEARCHES[side]([*words, f"study.seed={replicate}", f"study.seeds={seeds}"], task.budget_s, folder)


def scores_of(rows: Sequence[Row], task: str) -> tuple[list[int], dict[str, FloatArray]]:
    """Return the replicates, and mean scores over seeds of the default configuration and of each side.

    Args:
        rows: Rows of the results. Only seeds that have scores of all sides count, and replicates with such a seed.
        task: Name of the task.

    Returns:
        Numbers of the replicates, and scores of each side, shape (n_replicates, n_volumes).
    """
    replicates, scores = [], {side: [] for side in (DEFAULT, *SEARCHES)}
    of_task = [row for row in rows if row["task"] == task]
    for replicate in sorted({row["replicate"] for row in of_task}):
        own = [row for row in of_task if row["replicate"] == replicate]
        best = {DEFAULT: {}, **{row["side"]: row["values"] for row in own if "side" in row}}
        trained = {
            side: {row["seed"]: row["scores"] for row in own if "seed" in row and row["values"] == values}
            for side, values in best.items()
        }
        seeds = set.intersection(*map(set, trained.values()))
        if best.keys() == scores.keys() and seeds:
            replicates.append(replicate)
            for side, of_seeds in trained.items():
                by_volume = [[score for _, score in sorted(of_seeds[seed].items())] for seed in seeds]
                scores[side].append(np.mean(by_volume, axis=0))
    return replicates, {side: np.array(each) for side, each in scores.items()}


def table(rows: Sequence[Row]) -> str:
    """Return the table of the results in Markdown."""
    columns = {name: column for name in TASKS if (column := _column(rows, name))}
    names = next(iter(columns.values()), {})
    return markdown(["", *columns], [[name, *(column[name] for column in columns.values())] for name in names])


def _column(rows: Sequence[Row], task: str) -> Mapping[str, str]:
    replicates, scores = scores_of(rows, task)
    if not replicates:
        return {}

    def mean(side: str, name: str) -> str:
        of_task = (row for row in rows if row["task"] == task and row.get("side") == side)
        return f"{fmean(row[name] for row in of_task if row['replicate'] in replicates):.1f}"

    def less(ours: str, theirs: str) -> str:
        return with_interval(paired_difference(scores[ours], scores[theirs]))

    signs = np.sign((scores[ARMSCAN] - scores[HYDRA]).mean(axis=1))
    return {
        "replicates": f"{len(replicates)}",
        "processor s spent: armscan, Hydra": ", ".join(mean(side, "processor_s") for side in SEARCHES),
        "trials: armscan, of them pruned; trainings of its race": (
            f"{mean(ARMSCAN, 'n_trials')}, {mean(ARMSCAN, 'n_pruned')}; {mean(ARMSCAN, 'n_raced')}"
        ),
        "trials: Hydra": mean(HYDRA, "n_trials"),
        "mean steps: default, armscan, Hydra": ", ".join(f"{each.mean():.3f}" for each in scores.values()),
        "armscan minus Hydra": less(ARMSCAN, HYDRA),
        "armscan minus default": less(ARMSCAN, DEFAULT),
        "Hydra minus default": less(HYDRA, DEFAULT),
        "replicates in which armscan is better, equal, worse": ", ".join(
            str((signs == sign).sum()) for sign in (-1, 0, 1)
        ),
    }
