"""One table over the runs of all folds of a cross-validation."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from armscan.config.defaults import FOLD
from armscan.errors import TrackingError, in_one_line
from armscan.training import TEST, Evaluation, MetricEstimates, ResultTable
from armscan.training.baselines import AGENT, RANDOM
from armscan.training.headline import beside_random, headline
from armscan.utils.run_files import BASELINES_FILE, EVALUATION_FILE

ALL_FOLDS = ", all folds"
AGENT_ON_ALL_FOLDS = f"{AGENT}{ALL_FOLDS}"


def folds_table(runs: Iterable[tuple[Path, Sequence[str]]], n_folds: int | None = None) -> ResultTable | None:
    """Return one table over the folds of a grid, with the baselines; None if it has none.

    Every subject is tested once for each seed, so that intervals resample subjects, as those of one run do.

    Args:
        runs: Folder of each run, and its overrides that differ from those of the others.
        n_folds: Number of folds of the grid. If some were not tested, the rows say so. Default: None, all were.

    Raises:
        TrackingError: If a file of evaluations is damaged.
    """
    # By title, training and fold.
    tested: dict[str, dict[str, dict[str, Evaluation]]] = {}
    for folder, varied in runs:
        overrides = dict(override.partition("=")[::2] for override in varied)
        if (fold := overrides.pop(FOLD, None)) is None:
            return None
        training = overrides.pop("seed", "")
        others = " ".join(f"{key}={value}" for key, value in overrides.items())
        for name, evaluation in _evaluations(folder).items():
            title = ", ".join(filter(None, (name, others)))
            # A baseline plays the same episodes for every training seed: they count once.
            training_of = training if name == AGENT_ON_ALL_FOLDS else ""
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
    for title in (title for title in figures if title.startswith(AGENT_ON_ALL_FOLDS)):
        of_random = title.replace(AGENT_ON_ALL_FOLDS, f"{RANDOM}{ALL_FOLDS}", 1)
        random = next(iter(joined[of_random].values())) if of_random in joined else None
        ours[title] = beside_random(figures[title], [*joined[title].values()], random)
        randoms |= {title: figures[of_random]} if random else {}
    which = ALL_FOLDS if n_folds in (None, len(common)) else f", {len(common)} of {n_folds} folds"
    figures, ours, randoms = (
        {title.replace(ALL_FOLDS, which, 1): of_title for title, of_title in each.items()}
        for each in (figures, ours, randoms)
    )
    return ResultTable(figures | ours, headline=headline(ours, randoms))


def _evaluations(folder: Path) -> dict[str, Evaluation]:
    """Return the episodes of the agent and the baselines on the test volumes of a run, by their names."""
    try:
        agent = Evaluation.of_dict(json.loads((folder / EVALUATION_FILE).read_text())[TEST])
        baselines = json.loads((folder / BASELINES_FILE).read_text())
        of_baselines = {f"{name}{ALL_FOLDS}": Evaluation.of_dict(each) for name, each in baselines.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise TrackingError(f"the evaluations in {folder} cannot be read: {in_one_line(error)}") from error
    return {AGENT_ON_ALL_FOLDS: agent, **of_baselines}
