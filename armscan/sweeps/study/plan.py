"""Plan of a study, without running it: its space, its progress, and the cost of the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from stat import S_ISDIR
from statistics import fmean

import optuna
from optuna.trial import TrialState
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from armscan.errors import printable
from armscan.sweeps.scheduling.population import Population
from armscan.sweeps.scheduling.race import budget, round_size
from armscan.sweeps.scheduling.state import StudyState, seconds_of
from armscan.sweeps.scheduling.termination import ended_because
from armscan.sweeps.space.parameter import describe
from armscan.sweeps.study.final_eval import FinalEvaluation, n_trainings
from armscan.sweeps.study.settings import FinalEvalSettings, StudySettings
from armscan.sweeps.study.warm_start import InitialTrials
from armscan.utils.console import WHOLE_CHARS, wide_console
from armscan.utils.text import counted

BYTES_A_MIB = 2**20


def print_plan(
    settings: StudySettings,
    population: Population | None,
    study: optuna.Study | None,
    final: FinalEvaluation | None,
    initial: Sequence[InitialTrials],
) -> None:
    """Print the space, the progress and cost of a started study, and the cost of the rest.

    Args:
        settings: Settings of the study.
        population: Its population; None if its trials are independent.
        study: Study of the search; None if it has not been started.
        final: Its final evaluation; None if it has not been started.
        initial: Initial trials of the study.
    """
    console = wide_console(WHOLE_CHARS)
    state = StudyState.of(study.get_trials(deepcopy=False) if study is not None else ())
    table = Table(
        Column("key", no_wrap=True),
        "values",
        "where",
        title=f"study {settings.name}: what is searched",
        title_justify="left",
    )
    for parameter in settings.space.parameters:
        needs = ", ".join(f"{name} is {' or '.join(map(str, values))}" for name, values in parameter.when.items())
        table.add_row(*map(Text, (parameter.name, describe(parameter.distribution), needs)))
    console.print(table)
    objectives = ", ".join(f"{direction} {name}" for name, direction in settings.objectives.items())
    limits = [counted(settings.n_trials, "trial")]
    limits += [f"{settings.timeout_hours:g} hours"] if settings.timeout_hours is not None else []
    limits += [f"{settings.max_env_steps:,} environment steps"] if settings.max_env_steps is not None else []
    limits += (
        [f"or fewer by {settings.terminator['_target_'].rpartition('.')[2]}"] if settings.terminator is not None else []
    )
    console.print(f"objective  {objectives}, over {_seeds(settings.seeds)}")
    console.print(f"limits     {', '.join(limits)}; {counted(settings.workers, 'worker')}")
    console.print(f"then       {_final(settings.final_eval, settings.n_trials)}")
    for each in initial:
        console.print(printable(f"begins     {each.message}"), markup=False, highlight=False)
    others = (("failed", state.failed), ("waiting", state.waiting))
    also = "".join(f", {len(trials)} {what}" for what, trials in others if trials)
    console.print(f"done       {counted(done := len(state.finished), 'trial')}{also}")
    if done:
        ended = ended_because(study, settings.asked) if study is not None else None
        ended = ended or settings.limit_reason(state)
        if ended:
            console.print(printable(f"ended      {ended}"), markup=False, highlight=False)
        # A trial of a population is one of the generations that its final trainings train.
        n_parts = population.n_generations if population is not None else 1
        n_left = 0 if ended else max(0, settings.n_trials - done)
        _print_cost(console, settings, state, final, n_left=n_left, n_parts=n_parts)
    else:
        console.print("cost       not known before the first trial has finished")


def _print_cost(
    console: Console,
    settings: StudySettings,
    state: StudyState,
    final: FinalEvaluation | None,
    *,
    n_left: int,
    n_parts: int,
) -> None:
    """Print the cost of the finished trials, and an estimate for `n_left` trials and the final evaluation.

    A final training takes as long as `n_parts` trials.
    """
    timed = [(trial, spent_s) for trial in state.finished if (spent_s := seconds_of(trial)) is not None]
    seconds = [spent_s for _, spent_s in timed]
    mean_s = fmean(seconds)
    spent_mib = sum(map(_size_bytes, Path(settings.folder).rglob("*"))) / BYTES_A_MIB
    # Final trainings are never pruned.
    whole_s = [spent_s for trial, spent_s in timed if trial.state == TrialState.COMPLETE]
    training_s = fmean(whole_s or seconds) * n_parts / len(settings.seeds)
    least, most = hours_left(settings, final, n_left=n_left, trial_s=mean_s, training_s=training_s)
    console.print(
        f"cost       {sum(seconds) / 3600:.2f} hours of workers, {state.busy_hours:.2f} hours in all, "
        f"{state.env_steps:,} environment steps, {spent_mib:.0f} MiB"
    )
    console.print(
        f"the rest   {counted(n_left, 'trial')} and the final evaluation, about {least:.2f} to {most:.2f} hours; "
        f"the trials alone {spent_mib / len(state.finished) * n_left:.0f} MiB ({mean_s:.0f} s a trial so far)"
        if most
        else "the rest   nothing: the study has finished"
    )


def _size_bytes(path: Path) -> int:
    """Return the size of a file; 0 for a folder, and for a file that a worker has just replaced or deleted."""
    try:
        stat = path.lstat()
    except OSError:
        return 0
    return 0 if S_ISDIR(stat.st_mode) else stat.st_size


def hours_left(
    settings: StudySettings, final: FinalEvaluation | None, *, n_left: int, trial_s: float, training_s: float
) -> tuple[float, float]:
    """Return a lower and an upper bound on the hours until a study ends, if no trial fails.

    For the lower bound no worker ever waits; for the upper bound no more final trainings run at a time than one round
    of the race has.

    Args:
        settings: Settings of the study.
        final: The final evaluation; None if it has not been started.
        n_left: Trials of the search that are left.
        trial_s: Seconds of a trial.
        training_s: Seconds of a final training.
    """
    bounds = final_trainings_left(settings, final, n_left=n_left)
    n_at_once = settings.workers, min(settings.workers, round_size(settings.final_eval.top_k + 1))
    search_s = n_left * trial_s / settings.workers
    least, most = ((search_s + n * training_s / at_once) / 3600 for n, at_once in zip(bounds, n_at_once, strict=True))
    return least, most


def final_trainings_left(settings: StudySettings, final: FinalEvaluation | None, *, n_left: int) -> tuple[int, int]:
    """Return a lower and an upper bound on the number of final trainings that are left.

    Args:
        settings: Settings of the study, which may have changed since the final evaluation was begun.
        final: The final evaluation; None if it has not been started.
        n_left: Trials of the search that are left, which may change the candidates, or not.
    """
    fewest, most = n_trainings(settings.final_eval, settings.n_trials)
    if final is None:
        return fewest, most
    if n_left:
        return min(fewest, final_trainings_left(settings, final, n_left=0)[0]), most
    final = replace(final, settings=settings.final_eval)
    race = final.race()
    wanted = set(final.trainings_of_test(race))
    n_tested = len(wanted & final.tested().keys())
    if race.is_over:
        return len(wanted) - n_tested, len(wanted) - n_tested
    asked = settings.final_eval
    n_racing = sum(not each.is_withdrawn for each in race.standings.values())
    bounds = budget(n_racing, min_seeds=asked.min_seeds, mean_seeds=asked.mean_seeds)
    least, most = (max(bound - race.n_trained, len(race.missing)) - n_tested for bound in bounds)
    return least + asked.test_seeds, most + 2 * asked.test_seeds


def _final(settings: FinalEvalSettings, n_trials: int) -> str:
    """Return how many trainings the final evaluation takes."""
    fewest, most = n_trainings(settings, n_trials)
    if not most:
        return "no final evaluation"
    candidates = counted(min(settings.top_k, n_trials), "candidate")
    n_first, n_mean = settings.min_seeds, settings.mean_seeds
    further = f" at first, and at most {n_mean} each on average," if n_first < n_mean else ""
    return (
        f"at most {most} final trainings, and with {candidates} at least {fewest}: the candidates and the control with "
        f"{counted(n_first, 'seed')} each{further} to select one, then that one and the control with "
        f"{settings.test_seeds} more each on the test volumes"
    )


def _seeds(seeds: Sequence[int]) -> str:
    return f"{'the seed' if len(seeds) == 1 else 'the seeds'} {', '.join(map(str, seeds))}"
