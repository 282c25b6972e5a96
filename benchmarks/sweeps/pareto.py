"""What pruning with two objectives is worth: the hypervolume that is kept, and the environment steps that it takes.

    python -m benchmarks.sweeps.pareto [folder=FOLDER] [trials=60] [replays=200] [study/pruner=pareto ...]

Two small variants of `speed_vs_success`, with one and with two degrees of freedom, run without pruning, at points drawn
at random. Their reports are replayed with the pruner, in other orders. A trial of the replay is
the same training as far as it goes, so that what differs is the pruning. A folder that has studies already is resumed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import optuna
from hydra.utils import instantiate
from optuna._hypervolume import compute_hypervolume
from optuna.pruners import BasePruner
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState

from armscan.config.compose import compose
from armscan.config.defaults import to_plain
from armscan.sweeps.scheduling.state import env_steps_of
from armscan.sweeps.storage.reports import keep_report, reports_of
from armscan.sweeps.storage.storage import open_storage
from armscan.utils.log import silence_library_warnings

STUDIES = {
    "y": ["projection=y", "training.env_steps=8000", "training.eval_every_env_steps=1000"],
    "zy": ["projection=zy", "training.env_steps=12000", "training.eval_every_env_steps=1500"],
}
# Environment steps of the first rung.
FIRST_RUNG = {"y": 2000, "zy": 3000}


@dataclass(frozen=True)
class Replay:
    """A study replayed with a pruner.

    Args:
        hypervolume: of the trials that ran to their end.
        env_steps: environment steps of all trials.
        n_pruned: number of pruned trials.
    """

    hypervolume: float
    env_steps: int
    n_pruned: int


def trials_of(folder: Path, name: str, n_trials: int) -> list[FrozenTrial]:
    """Run a study without pruning, and return its finished trials."""
    words = ["-m", "sweep=speed_vs_success", f"study.name={name}", f"study.n_trials={n_trials}", *STUDIES[name]]
    words += ["study.final_eval.top_k=0", "study/sampler=random", "study/pruner=none", "study.workers=1"]
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{name}.log").open("a") as log:
        subprocess.run(
            [sys.executable, "-m", "armscan.run", *words],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
            stdout=log,
            stderr=log,
            check=True,
        )
    return completed_in(folder, name)


def completed_in(folder: Path, name: str) -> list[FrozenTrial]:
    """Return the completed trials of the study of a folder."""
    study = optuna.load_study(study_name=name, storage=open_storage(str(folder / "optuna.journal")).optuna)
    return study.get_trials(states=(TrialState.COMPLETE,))


def replay(trials: Sequence[FrozenTrial], pruner: BasePruner) -> Replay:
    """Replay trials one after another with a pruner."""
    directions = [StudyDirection.MAXIMIZE, StudyDirection.MINIMIZE]
    study = optuna.create_study(directions=directions, pruner=pruner)
    env_steps = n_pruned = 0
    for trial in trials:
        taken = _replayed(study, trial)
        env_steps += env_steps_of(trial) if taken is None else taken
        n_pruned += taken is not None
    losses = _losses(trials)
    kept = _losses(study.get_trials(states=(TrialState.COMPLETE,)))
    # The worst of all trials: what a front keeps does not depend on what was pruned.
    return Replay(hypervolume_of(kept, losses), env_steps, n_pruned)


def hypervolume_of(losses: np.ndarray, of_all: np.ndarray) -> float:
    """Return the hypervolume of losses up to the worst of all trials, as a share of the box of all trials."""
    best, worst = of_all.min(axis=0), of_all.max(axis=0)
    scaled = (losses - best) / np.where(worst > best, worst - best, 1.0)
    return float(compute_hypervolume(scaled, np.ones(2)))


def _replayed(study: optuna.Study, trial: FrozenTrial) -> int | None:
    """Run one trial of a replay; returns the environment steps after which it was pruned, None if it was not."""
    again = study.ask()
    for step, values in reports_of(trial).items():
        keep_report(again.storage, again._trial_id, step, values)
        if study.pruner.prune(study, _frozen(again)):
            study.tell(again, state=TrialState.PRUNED)
            return step
    study.tell(again, trial.values)
    return None


def _frozen(trial: Trial) -> FrozenTrial:
    return trial.storage.get_trial(trial._trial_id)


def _losses(trials: Sequence[FrozenTrial]) -> np.ndarray:
    return np.array([trial.values for trial in trials]) * [-1.0, 1.0]


def compare(trials: Sequence[FrozenTrial], name: str, pruner: BasePruner, n_replays: int) -> None:
    """Print what pruning keeps and saves, over replays in other orders."""
    plain, rng = replay(trials, optuna.pruners.NopPruner()), np.random.default_rng(0)
    replays = [replay([trials[each] for each in rng.permutation(len(trials))], pruner) for _ in range(n_replays)]
    kept = np.array([each.hypervolume / plain.hypervolume for each in replays])
    spent = np.array([each.env_steps / plain.env_steps for each in replays])
    n_pruned = np.mean([each.n_pruned for each in replays])
    print(
        f"{name}: {len(trials)} trials, {plain.env_steps:,} environment steps, hypervolume {plain.hypervolume:.3f}; "
        f"pruned {n_pruned:.1f} on average: hypervolume {kept.mean():.1%} (5 % of the replays below "
        f"{np.quantile(kept, 0.05):.1%}), environment steps {spent.mean():.1%} (5 % of them above "
        f"{np.quantile(spent, 0.95):.1%})",
        flush=True,
    )


def main(words: list[str]) -> None:
    """Run what is asked for."""
    given = {word.split("=", 1)[0]: word.split("=", 1)[1] for word in words if not word.startswith("study")}
    of_study = [word for word in words if word.startswith("study")]
    folder = Path(given.get("folder") or tempfile.mkdtemp()).absolute()
    silence_library_warnings()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    for name in given.get("studies", ",".join(STUDIES)).split(","):
        rung = f"study.prune_after_env_steps={FIRST_RUNG[name]}"
        study = compose(["sweep=speed_vs_success", "study/pruner=pareto", rung, *STUDIES[name], *of_study]).study
        trials = trials_of(folder, name, int(given.get("trials", "60")))
        compare(trials, name, instantiate(to_plain(study.pruner)), int(given.get("replays", "200")))


if __name__ == "__main__":
    main(sys.argv[1:])
