"""One table over the runs of all folds of a cross-validation."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from armscan.config.defaults import FOLD
from armscan.reports.html import page
from armscan.training import TEST, Evaluation, MetricEstimates, ResultTable
from armscan.training.baselines import RANDOM
from armscan.training.episode_results import TEST_METRICS, metric_prefix
from armscan.training.headline import ABOVE_RANDOM, beside_random, headline
from armscan.utils.files import atomic_write
from armscan.utils.run_files import BASELINES_FILE, EVALUATION_FILE, RESULTS_PAGE

if TYPE_CHECKING:
    from armscan.tracking import TrackingStore

SEED = "seed"
ALL_FOLDS = ", all folds"
AGENT = f"agent{ALL_FOLDS}"


def folds_table(runs: Iterable[tuple[Path, Sequence[str]]], n_folds: int | None = None) -> ResultTable | None:
    """Return one table over the folds of a grid, with the baselines; None if it is not a grid of folds.

    Every subject is tested once for each seed, so that intervals resample subjects, as those of one run do.

    Args:
        runs: Folder of each run, and its overrides that differ from those of the others.
        n_folds: Number of folds of the grid. If some were not tested, the rows say so. Default: None, all were.
    """
    # By title, training and fold.
    tested: dict[str, dict[str, dict[str, Evaluation]]] = {}
    for folder, varied in runs:
        words = dict(word.partition("=")[::2] for word in varied)
        if (fold := words.pop(FOLD, None)) is None:
            return None
        training = words.pop(SEED, "")
        others = " ".join(f"{key}={value}" for key, value in words.items())
        for name, evaluation in _evaluations(folder).items():
            title = ", ".join(filter(None, (name, others)))
            # A baseline plays the same episodes for every training seed: they count once.
            training_of = training if name == AGENT else ""
            tested.setdefault(title, {}).setdefault(training_of, {})[fold] = evaluation
    # Otherwise the volumes of folds that one seed lacks would count less.
    of_each = [set(folds) for by_training in tested.values() for folds in by_training.values()]
    common = set.intersection(*of_each) if of_each else set()
    if not common:
        return None
    joined = {
        title: {
            training: Evaluation.pooled([evaluation for fold, evaluation in each.items() if fold in common])
            for training, each in by_training.items()
        }
        for title, by_training in tested.items()
    }
    figures = {title: MetricEstimates.of_trainings(each) for title, each in joined.items()}
    ours: dict[str, MetricEstimates] = {}
    randoms: dict[str, MetricEstimates] = {}
    for title in (title for title in figures if title.startswith(AGENT)):
        of_random = title.replace(AGENT, f"{RANDOM}{ALL_FOLDS}", 1)
        random = next(iter(joined[of_random].values())) if of_random in joined else None
        ours[title] = beside_random(figures[title], [*joined[title].values()], random)
        randoms |= {title: figures[of_random]} if random else {}
    which = ALL_FOLDS if n_folds in (None, len(common)) else f", {len(common)} of {n_folds} folds"
    figures, ours, randoms = (
        {title.replace(ALL_FOLDS, which, 1): of_title for title, of_title in each.items()}
        for each in (figures, ours, randoms)
    )
    return ResultTable(figures | ours, headline=headline(ours, randoms)) if figures else None


def _evaluations(folder: Path) -> dict[str, Evaluation]:
    """Return the episodes of the agent and the baselines on the test volumes of a run, by their names."""
    agent = Evaluation.of_dict(json.loads((folder / EVALUATION_FILE).read_text())[TEST])
    baselines = json.loads((folder / BASELINES_FILE).read_text())
    return {AGENT: agent, **{f"{name}{ALL_FOLDS}": Evaluation.of_dict(each) for name, each in baselines.items()}}


def keep_table(
    table: ResultTable, jobs: ResultTable, folder: Path, store: TrackingStore, run_id: str, notes: Sequence[str]
) -> None:
    """Save the tables of all folds and of the jobs in the grid's folder, and with the figures in the grid's run.

    Args:
        table: Table of all folds.
        jobs: Table of the jobs, shown below.
        folder: Folder of the grid.
        store: Store of the grid's run.
        run_id: MLflow run ID of the grid.
        notes: Notes on the table, such as missing folds.

    Raises:
        TrackingError: If the store is unavailable.
    """
    from mlflow.entities import Metric

    from armscan.tracking.outbox import now_ms
    from armscan.tracking.uploader import set_description

    file = folder / RESULTS_PAGE
    text = page("all folds (test)", f"{table.html()}<h2>Jobs</h2>{jobs.html()}", notes=notes)
    atomic_write(file, text)
    time_ms = now_ms()
    # If runs also differ in other settings, or folds are missing, only the page has their figures.
    groups = {
        title: TEST_METRICS if title == AGENT else metric_prefix(title.removesuffix(ALL_FOLDS))
        for title in table.results
        if title.endswith(ALL_FOLDS)
    }
    shown = [*(column.metric for column in table.quantities), ABOVE_RANDOM]
    metrics = [
        Metric(f"{group}/{name}", value, time_ms, 0)
        for title, group in groups.items()
        for name, value in table.results[title].shown_metrics(shown).items()
        if math.isfinite(value)
    ]
    store.log_batch(run_id, metrics=metrics)
    store.log_artifact(run_id, str(file))
    set_description(store, run_id, "\n\n".join([*notes, table.markdown()]))
