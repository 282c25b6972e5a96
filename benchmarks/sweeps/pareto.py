"""Measure pruning with two objectives: the hypervolume kept and the environment steps taken.

    python -m benchmarks.sweeps.pareto [--folder FOLDER] [--trials 60] [--replays 200]

Two studies with random sampling and no pruning are replayed with `study/pruner=pareto`, each time with some of the
trials in another random order (default: 60). A replayed trial is the same training until it is pruned, so that only the
pruning differs.

- `speed_vs_success` along the arm: success rate and environment steps until it is solved. If the folder already has the
  study, it is resumed.
- `sac_y`: mean steps and processor seconds, of the trainings in the table of the bench (`benchmarks/sweeps/bench`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np
import optuna
from optuna._hypervolume import compute_hypervolume
from optuna.pruners import BasePruner, NopPruner
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState, create_trial

from armscan.sweeps.scheduling.state import env_steps_of, loss_signs
from armscan.sweeps.storage.attribute_names import ENV_STEPS
from armscan.sweeps.storage.reports import REPORT, reports_of, store_report
from armscan.sweeps.study.pruners import ParetoPruner
from benchmarks.arguments import add_options_of, call, parser_of
from benchmarks.sweeps.bench.table import SELECTION, VALIDATION, read_rows, table_file
from benchmarks.sweeps.studies import run_study

WORDS = ("projection=y", "training.env_steps=8000", "training.eval_every_env_steps=1000")
DIRECTIONS = (StudyDirection.MAXIMIZE, StudyDirection.MINIMIZE)


@dataclass(frozen=True)
class Unpruned:
    """A study without pruning.

    Args:
        name: Name of the study, and its objectives.
        directions: Direction of each objective.
        first_rung: Environment steps of the first rung.
        trials: Its trials.
    """

    name: str
    directions: tuple[StudyDirection, StudyDirection]
    first_rung: int
    trials: Sequence[FrozenTrial]

    def losses(self, trials: Sequence[FrozenTrial]) -> np.ndarray:
        """Return the objectives of trials as losses, from 0 for the best to 1 for the worst of all trials."""
        signs = loss_signs(self.directions)
        of_all, values = (np.array([trial.values for trial in each]) * signs for each in (self.trials, trials))
        best, worst = of_all.min(axis=0), of_all.max(axis=0)
        return np.asarray((values - best) / np.where(worst > best, worst - best, 1.0))

    def hypervolume(self, trials: Sequence[FrozenTrial]) -> float:
        """Return the hypervolume of trials as a share of the box of all trials."""
        return float(compute_hypervolume(self.losses(trials), np.ones(2)))


def speed_vs_success(folder: Path, n_trials: int) -> Unpruned:
    """Run a small variant of `speed_vs_success` without pruning."""
    words = [*WORDS, f"study.n_trials={n_trials}", "study/sampler=random", "study/pruner=none", "study.workers=1"]
    study = run_study(folder, "speed_vs_success", "y", *words)
    trials = study.get_trials(states=(TrialState.COMPLETE,))
    return Unpruned("speed_vs_success (success rate, environment steps)", DIRECTIONS, 2000, trials)


def sac_y() -> Unpruned:
    """Return the trainings of the table of `sac_y`, each as a trial of two objectives."""
    rows = read_rows(table_file("sac_y"))
    trials = []
    for _, training in rows.groupby(["config", "seed"]):
        ordered = training[training.volumes == VALIDATION].sort_values("env_steps")
        best = accumulate(ordered.mean_steps, min)
        reports = {
            int(step): [so_far, seconds]
            for step, so_far, seconds in zip(ordered.env_steps, best, ordered.processor_s, strict=True)
        }
        values = [training[training.volumes == SELECTION].mean_steps.item(), ordered.processor_s.iloc[-1]]
        of_reports = {f"{REPORT}{step}": report for step, report in reports.items()}
        trials.append(create_trial(values=values, system_attrs=of_reports, user_attrs={ENV_STEPS: max(reports)}))
    return Unpruned("sac_y (mean steps, processor seconds)", (StudyDirection.MINIMIZE,) * 2, 2500, trials)


def replay(unpruned: Unpruned, trials: Sequence[FrozenTrial], pruner: BasePruner) -> tuple[float, int, int]:
    """Replay trials one after another with a pruner; returns hypervolume, environment steps and pruned trials."""
    study = optuna.create_study(directions=unpruned.directions, pruner=pruner)
    env_steps = n_pruned = 0
    for trial in trials:
        taken = _replayed(study, trial)
        env_steps += env_steps_of(trial) if taken is None else taken
        n_pruned += taken is not None
    return unpruned.hypervolume(study.get_trials(states=(TrialState.COMPLETE,))), env_steps, n_pruned


def _replayed(study: optuna.Study, trial: FrozenTrial) -> int | None:
    """Run one trial of a replay; returns the environment steps after which it was pruned, None if it was not."""
    again = study.ask()
    for step, values in reports_of(trial).items():
        store_report(again.storage, again._trial_id, step, values)
        if study.pruner.prune(study, again.storage.get_trial(again._trial_id)):
            study.tell(again, state=TrialState.PRUNED)
            return step
    study.tell(again, trial.values)
    return None


def compare(unpruned: Unpruned, n_trials: int, n_replays: int) -> None:
    """Print what pruning keeps and saves, over replays of some trials in random orders."""
    rng, pruners = np.random.default_rng(0), (NopPruner(), ParetoPruner(unpruned.first_rung))
    drawn = [rng.permutation(len(unpruned.trials))[:n_trials] for _ in range(n_replays)]
    orders = [[unpruned.trials[each] for each in of_replay] for of_replay in drawn]
    plain, pruned = (np.array([replay(unpruned, order, pruner) for order in orders]) for pruner in pruners)
    kept, spent = (pruned[:, :2] / plain[:, :2]).T
    print(
        f"{unpruned.name}: {len(orders[0])} of {len(unpruned.trials)} trials in each of {n_replays} replays; "
        f"{pruned[:, 2].mean():.1f} pruned on average, hypervolume {kept.mean():.1%} of that without pruning (5 % of "
        f"the replays below {np.quantile(kept, 0.05):.1%}), environment steps {spent.mean():.1%} (5 % above "
        f"{np.quantile(spent, 0.95):.1%})",
        flush=True,
    )


def main(folder: Path, *, trials: int = 60, replays: int = 200) -> None:
    """Measure both studies."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    for unpruned in (sac_y(), speed_vs_success(folder, trials)):
        compare(unpruned, trials, replays)


if __name__ == "__main__":
    parser = parser_of(__doc__)
    add_options_of(parser, main)
    call(main, parser.parse_args())
