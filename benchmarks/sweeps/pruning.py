"""Measure what pruning saves: the study `sac_y` with its pruner, and without one.

    python -m benchmarks.sweeps.pruning [--folder FOLDER] [--seeds 0 1 2] [--trials 40]

Both studies of a seed sample the same random points, so that a trial is the same training in both until it is pruned,
and only the pruning differs. Studies already in the folder are resumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from optuna.trial import FrozenTrial, TrialState

from armscan.sweeps.scheduling.state import StudyState, env_steps_of
from benchmarks.arguments import add_options_of, call, parser_of
from benchmarks.sweeps.studies import run_study

STUDIES = {"plain": ["study/pruner=none"], "pruned": []}


def trials_of(folder: Path, seed: int, name: str, n_trials: int) -> list[FrozenTrial]:
    """Run a study, and return its trials in the order in which they ended."""
    words = [f"study.seed={seed}", f"study.n_trials={n_trials}", "study/sampler=random", *STUDIES[name]]
    study = run_study(folder, "sac_y", name, *words)
    return sorted(StudyState.of(study.trials).finished, key=lambda trial: str(trial.datetime_complete))


def env_steps_until(trials: list[FrozenTrial], value: float) -> int | None:
    """Return the environment steps of all trials up to the first that reached a value; None if none did."""
    n_env_steps = 0
    for trial in trials:
        n_env_steps += env_steps_of(trial)
        if trial.state == TrialState.COMPLETE and trial.values[0] <= value:
            return n_env_steps
    return None


def compare(folder: Path, seed: int, n_trials: int) -> None:
    """Print the results of both studies of a seed."""
    plain, pruned = (trials_of(folder, seed, name, n_trials) for name in STUDIES)
    best = {
        name: min(trial.values[0] for trial in each if trial.state == TrialState.COMPLETE)
        for name, each in (("plain", plain), ("pruned", pruned))
    }
    total, total_pruned = (sum(map(env_steps_of, each)) for each in (plain, pruned))
    n_pruned = sum(trial.state == TrialState.PRUNED for trial in pruned)
    reached = env_steps_until(pruned, best["plain"])
    when = "never" if reached is None else f"after {reached:,} ({reached / total:.0%})"
    alone = env_steps_until(plain, best["plain"])
    print(f"seed {seed}: plain {total:,} environment steps, best {best['plain']:.3f} after {alone:,}")
    print(
        f"        pruned {total_pruned:,} ({total_pruned / total:.0%}), {n_pruned} of {len(pruned)} trials pruned, "
        f"best {best['pruned']:.3f}, as good as the plain one's best {when}",
        flush=True,
    )


def main(folder: Path, *, seeds: Sequence[int] = (0, 1, 2), trials: int = 40) -> None:
    """Compare the studies of each seed."""
    for seed in seeds:
        compare(folder / f"seed_{seed}", seed, trials)


if __name__ == "__main__":
    parser = parser_of(__doc__)
    add_options_of(parser, main)
    call(main, parser.parse_args())
