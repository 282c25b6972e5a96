"""The picture of a bench: samplers and pruners, races compared with fixed seeds, and the effect of each key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.sweeps.bench.importance import Key
from benchmarks.sweeps.bench.races import Choices
from benchmarks.sweeps.bench.ranking import PRUNERS, curve_of

# One for each of `RACES`.
MARKERS = "os^Dv<>pPX*hHd8+"
Races = tuple[Sequence[Choices], Mapping[str, Choices]]


def draw(ranks: pd.DataFrame, races: Mapping[int, Races], keys: Mapping[str, Key], path: Path, *, title: str) -> None:
    """Draw the picture as a PNG file.

    Args:
        ranks: Rows of `ranked`.
        races: Fixed seeds and races, by the number of candidates; the last are drawn.
        keys: Importance and effect of each key.
        path: The file.
        title: Title of the picture.
    """
    figure = Figure(figsize=(14, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3)
    _draw_ranks(left, ranks)
    top_k = list(races)[-1]
    _draw_races(middle, *races[top_k], title=f"choosing among {top_k} candidates and the control")
    _draw_keys(right, keys)
    figure.suptitle(title)
    figure.savefig(path, dpi=110)


def _draw_ranks(axes: Axes, ranks: pd.DataFrame) -> None:
    names = [f"{row.sampler}{row.further}" for row in ranks.itertuples()]
    order = list(dict.fromkeys(names))[::-1]
    for place, pruner in enumerate(PRUNERS):
        is_drawn = (ranks.pruner == pruner).to_numpy()
        rows = ranks[is_drawn]
        heights = [order.index(name) + 0.2 * ((len(PRUNERS) - 1) / 2 - place) for name in np.array(names)[is_drawn]]
        ends = np.abs(rows[["low", "high"]].to_numpy().T - rows.regret.to_numpy())
        axes.errorbar(rows.regret, heights, xerr=ends, fmt="o", capsize=2, label=f"pruner {pruner}")
    axes.set_yticks(range(len(order)), order)
    axes.set_xlabel("mean steps above the best settings, 95 % interval")
    axes.set_xlim(left=0)
    axes.set_title("what a study chooses, by sampler and pruner")
    axes.grid(alpha=0.3)
    axes.legend(ncols=2, fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.16))


def _draw_races(axes: Axes, fixed: Sequence[Choices], races: Mapping[str, Choices], *, title: str) -> None:
    curve = curve_of([each.regret for each in fixed])
    n_trainings = [each.n_trainings.mean() for each in fixed]
    axes.plot(n_trainings, curve[:, 0], marker=".", color="tab:grey", label="the same seeds for all")
    axes.fill_between(n_trainings, curve[:, 1], curve[:, 2], color="tab:grey", alpha=0.2)
    for (name, race), marker in zip(races.items(), MARKERS, strict=True):
        ((value, *ends),) = curve_of([race.regret])
        lengths = [[abs(end - value)] for end in ends]
        look = {"fmt": marker, "capsize": 2, "label": name}
        axes.errorbar(race.n_trainings.mean(), value, yerr=lengths, **look)
    axes.set_xscale("log")
    axes.set_xlabel("trainings of the choice")
    axes.set_ylabel("mean steps above the best candidate")
    axes.set_yscale("log")
    axes.set_title(title)
    axes.grid(alpha=0.3, which="both")
    # Below the axes, where the legend hides no race.
    axes.legend(fontsize=7, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.16))


def _draw_keys(axes: Axes, keys: Mapping[str, Key]) -> None:
    for name, key in keys.items():
        (line,) = axes.plot(key.places, key.steps[:, 0], marker="o", label=name)
        axes.fill_between(key.places, key.steps[:, 1], key.steps[:, 2], color=line.get_color(), alpha=0.12)
    axes.set_xlabel("a key from its lowest or first value to its last")
    axes.set_ylabel("mean steps, averaged over the other keys")
    axes.set_title("the effect of each key")
    axes.grid(alpha=0.3)
    axes.legend()
