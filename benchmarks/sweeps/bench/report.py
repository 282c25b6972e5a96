"""The tables of a bench, as Markdown, and its picture."""

from __future__ import annotations

from collections.abc import Sequence
from math import floor, isfinite
from pathlib import Path
from typing import Any

import pandas as pd

from armscan.errors import InvalidValueError
from armscan.utils.arrays import FloatArray
from armscan.utils.text import markdown_table
from benchmarks.sweeps.bench.episodes import N_BLOCKS, N_EPISODES, Evaluations, races, share_of_noise
from benchmarks.sweeps.bench.importance import Key, keys_of
from benchmarks.sweeps.bench.picture import draw
from benchmarks.sweeps.bench.power import needed_seeds, power_of, residuals_of
from benchmarks.sweeps.bench.races import FIXED, N_SEEDS, RACES, Choices, Comparison, candidates_of, choices_of, compare
from benchmarks.sweeps.bench.ranking import FINALS, SAMPLERS, ranked, rules, studies_of
from benchmarks.sweeps.bench.replay import DEFAULT
from benchmarks.sweeps.bench.surrogate import Surrogate, fit_of
from benchmarks.sweeps.bench.table import Curves

# Candidates of the races, beside the control: those of the default study, and more.
TOP_KS = (3, 8)
RACE_HEAD = ("trainings", "regret", "fixed seeds need", "share")


def report(
    sweep: str,
    *,
    n_studies: int,
    n_trainings: int,
    n_resamples: int,
    samplers: Sequence[str] = SAMPLERS,
    workers: int = 1,
    picture: Path | None = None,
) -> None:
    """Print the tables of a sweep, and draw the picture.

    Args:
        sweep: Name of the sweep.
        n_studies: Simulated studies of each rule.
        n_trainings: Budget of the search of each, in whole trainings.
        n_resamples: Resamples of the importances' intervals.
        samplers: Samplers that are compared. Default: all but `gp`.
        workers: Processes that simulate studies. Default: 1, this one.
        picture: File of the picture. Default: None, no picture.
    """
    curves = Curves.read(sweep)
    surrogate = Surrogate.of(curves)
    _print_table(curves, surrogate)
    for name, residuals in residuals_of(surrogate).items():
        _print_power(name, residuals)
    keys = keys_of(curves, n_resamples)
    _print_keys(keys)
    found = candidates_of(surrogate, sweep, DEFAULT, n_studies=n_studies, n_trainings=n_trainings, top_k=max(TOP_KS))
    control, raced_by = surrogate.config(curves.configs[0]), {}
    if (least := min(map(len, found))) < max(TOP_KS):
        raise InvalidValueError(
            f"a search has {least} finished trials, but {max(TOP_KS)} are raced: give a larger --trainings"
        )
    for top_k in TOP_KS:
        candidates = [[control, *of_study[:top_k]] for of_study in found]
        fixed = list(choices_of(candidates, FIXED).values())
        raced = choices_of(candidates, RACES)
        raced_by[top_k] = fixed, raced
        _print_races(top_k, fixed, compare(fixed, raced))
    compared, size = rules(samplers), {"n_studies": n_studies, "n_trainings": n_trainings}
    studies = studies_of(surrogate, control, sweep, compared, **size, workers=workers)
    ranks = ranked(studies)
    _print_ranks(ranks)
    if picture is not None:
        draw(ranks, raced_by, keys, picture, title=f"{sweep}: {len(curves.configs)} configurations")


def report_episodes(sweep: str, *, n_studies: int, n_trainings: int) -> None:
    """Print how much noise between seeds remains with more episodes, and what they are worth to a race.

    Args:
        sweep: Name of the sweep.
        n_studies: Simulated studies.
        n_trainings: Budget of the search of each, in whole trainings.
    """
    evaluated = Evaluations.read(sweep)
    noise = evaluated.noise()
    rows = [
        (
            len(some),
            *(f"{100 * each:.0f}" for each in some.mean(axis=0) ** 0.5),
            with_interval(share_of_noise(some), ".2f"),
        )
        for some in (noise, noise[: len(noise) // 4])
    ]
    lengths = (N_EPISODES, N_BLOCKS * N_EPISODES)
    head = ["best configurations", *(f"noise with {each:,} episodes, in %" for each in lengths), "variance, as a share"]
    print(f"{len(evaluated.config_of)} trainings\n\n{markdown(head, rows)}", flush=True)
    for top_k in TOP_KS:
        compared = races(evaluated, n_studies=n_studies, n_trainings=n_trainings, top_k=top_k)
        rows = [(name, *_race_cells(each)) for name, each in compared.items()]
        print(f"\n{markdown([f'{top_k} candidates and the control', *RACE_HEAD], rows)}", flush=True)


def markdown(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table in Markdown."""
    return markdown_table([*map(str, head)], [[*map(str, row)] for row in rows])


def with_interval(estimate: Sequence[float], form: str = ".3f") -> str:
    """Return an estimate with its interval, such as `0.12 (0.10 to 0.15)`."""
    value, low, high = estimate
    return f"{value:{form}} ({low:{form}} to {high:{form}})"


def _print_table(curves: Curves, surrogate: Surrogate) -> None:
    best, truth = surrogate.best()
    correlation, explained = fit_of(curves)
    default = float(curves.mean_over_seeds(curves.test["mean_steps"])[0])
    rows = [
        ("configurations, trainings", f"{len(curves.configs)}, {len(curves.config_of)}"),
        ("processor hours", f"{curves.processor_s.sum() / 3600:.1f}"),
        ("mean steps in the test: the default configuration, the best of the surrogate", f"{default:.2f}, {truth:.2f}"),
        ("the best of the surrogate", ", ".join(f"`{name}={value:.3g}`" for name, value in best.items())),
        ("configurations left out: rank correlation, variance explained", f"{correlation:.2f}, {explained:.2f}"),
    ]
    print(f"\n## {curves.sweep}\n\n{markdown(['', ''], rows)}", flush=True)


def _print_power(name: str, residuals: FloatArray) -> None:
    power = power_of(residuals)
    needed = needed_seeds(power)
    rows = [
        # Rounded down, so that no share below 80 % reads as 80 %.
        (f"{difference:.0%}", *(floor(100 * share) for share in row), needed.get(float(difference), "") or "none")
        for difference, row in power.iterrows()
    ]
    print(f"\nNoise between seeds of {name}: {100 * residuals.std():.0f} % of the steps")
    print(f"\n{markdown(['difference', *power.columns, 'first with 80 %'], rows)}", flush=True)


def _print_keys(keys: dict[str, Key]) -> None:
    rows = [
        (
            f"`{name}`",
            with_interval(key.fanova, ".2f"),
            with_interval(key.ped_anova, ".2f"),
            with_interval(key.effect, ".2f"),
        )
        for name, key in keys.items()
    ]
    head = ["key", "fANOVA", "PED-ANOVA", "steps of the worst value / of the best"]
    print(f"\n{markdown(head, rows)}", flush=True)


def _print_races(top_k: int, fixed: Sequence[Choices], compared: Sequence[Comparison]) -> None:
    rows = [
        (n_seeds, f"{each.n_trainings.mean():.0f}", f"{each.regret.mean():.4f}")
        for n_seeds, each in zip(N_SEEDS, fixed, strict=True)
    ]
    print(f"\n{top_k} candidates and the control\n\n{markdown(['seeds of each', 'trainings', 'regret'], rows)}")
    rows = [(each.rule, *_race_cells(each)) for each in compared]
    print(f"\n{markdown(['rule', *RACE_HEAD], rows)}", flush=True)


def _race_cells(race: Comparison) -> tuple[str, str, str, str]:
    is_reached = isfinite(race.n_fixed)
    return (
        f"{race.n_trainings:.1f}",
        with_interval(race.regret, ".4f"),
        f"{race.n_fixed:.1f}" if is_reached else f"> {race.most_fixed:.0f}",
        ("" if is_reached else "< ") + with_interval(race.share, ".2f"),
    )


def _print_ranks(ranks: pd.DataFrame) -> None:
    rows = [
        (
            f"{row.sampler}, {row.pruner}{row.further}",
            with_interval((row.regret, row.low, row.high)),
            f"{row.fixed:.3f}",
            f"{row.control:.3f}",
            f"{row.eight:.3f}",
            f"{row.search:.3f}",
            ", ".join(f"{getattr(row, f'{name}_trainings'):.1f}" for name in FINALS),
            f"{row.n_trials:.0f}",
            with_interval((row.better, row.better_low, row.better_high), ".2f"),
            row.n_studies,
        )
        for row in ranks.itertuples()
    ]
    head = [
        "sampler, pruner",
        "regret, race",
        "fixed",
        "race with the control",
        "eight candidates and the control",
        "search alone",
        "trainings: fixed, race, with the control, eight",
        "trials",
    ]
    print(f"\n{markdown([*head, 'better than random, none', 'studies'], rows)}", flush=True)
