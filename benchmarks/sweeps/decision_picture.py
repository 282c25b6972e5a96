"""Draw `docs/images/how_a_study_decides.svg`: one simulated study from its search to its result.

    python -m benchmarks.sweeps.decision_picture

The scores are simulated; the race and the interval of the difference are armscan's own.
"""

from __future__ import annotations

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from armscan.reports.chart_style import BLUE, GREY, ORANGE
from armscan.stats.aggregation import probability_of_improvement
from armscan.stats.paired import paired_difference
from armscan.sweeps.scheduling.race import MAX_SEEDS_FACTOR, Race, race
from benchmarks.arguments import parser_of
from benchmarks.repository import PICTURES

N_TRIALS, N_VALIDATION, N_TEST, N_TEST_SEEDS = 30, 8, 12, 5
MIN_SEEDS, MEAN_SEEDS = 2, 12
MAX_SEEDS = MAX_SEEDS_FACTOR * MEAN_SEEDS
CONTROL, CONTROL_STEPS = -1, 2.6
# Standard deviations in steps: between trainings, between volumes, and of a single trial's value.
OF_SEEDS, OF_VOLUMES, LUCK = 0.35, 0.4, 0.5
SEED = 72
# Background of texts, so that no line runs through them.
PAPER = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}


def main() -> None:
    """Simulate the study and draw it."""
    parser_of(__doc__).parse_args()
    rng = np.random.default_rng(SEED)
    true = np.clip(1.5 + rng.gamma(1.6, 1.1, N_TRIALS), 1.5, 8.0)
    seen = np.maximum(1.0, true + LUCK * rng.standard_normal(N_TRIALS))
    steps = {CONTROL: CONTROL_STEPS} | {int(number): float(true[number]) for number in seen.argsort()[:3]}

    def trained(number: int, n_seeds: int, n_volumes: int) -> np.ndarray:
        of_seeds = OF_SEEDS * rng.standard_normal((n_seeds, 1))
        return np.maximum(1.0, steps[number] + of_seeds + OF_VOLUMES * rng.standard_normal((n_seeds, n_volumes)))

    scores = {number: dict(enumerate(-trained(number, MAX_SEEDS, N_VALIDATION).mean(axis=1))) for number in steps}
    raced = race(scores, range(MAX_SEEDS), min_seeds=MIN_SEEDS, mean_seeds=MEAN_SEEDS)
    assert raced.chosen is not None
    ours, theirs = (trained(number, N_TEST_SEEDS, N_TEST) for number in (raced.chosen, CONTROL))
    mpl.rcParams |= {
        "font.family": "sans-serif",
        "font.size": 10,
        "svg.fonttype": "none",
        "svg.hashsalt": "armscan",
        "axes.titlesize": 11,
    }
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), width_ratios=(1.15, 1.2, 1))
    draw_search(axes[0], seen, steps)
    draw_selection(axes[1], scores, raced)
    draw_test(axes[2], ours, theirs, raced.chosen)
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
    figure.tight_layout(w_pad=2.5)
    figure.savefig(PICTURES / "how_a_study_decides.svg", metadata={"Date": None})


def draw_search(axes: Axes, seen: np.ndarray, steps: dict[int, float]) -> None:
    """Draw the values of the trials, candidates in colour."""
    are_candidates = np.isin(np.arange(len(seen)), list(steps))
    axes.scatter(np.flatnonzero(~are_candidates), seen[~are_candidates], color=GREY, s=22, label="trial")
    axes.scatter(
        np.flatnonzero(are_candidates), seen[are_candidates], color=ORANGE, s=40, label="the best become candidates"
    )
    axes.axhline(CONTROL_STEPS, color=BLUE, linestyle=":", linewidth=1.2, label="control, not searched")
    axes.set(title="1  Search: validation volumes", xlabel="trial", ylabel="steps (lower is better)")
    axes.set_ylim(0, float(seen.max()) * 1.35)
    axes.legend(frameon=False, loc="upper right", fontsize=8.5)


def draw_selection(axes: Axes, scores: dict[int, dict[int, float]], raced: Race) -> None:
    """Draw the seeds that each candidate was trained with, and its interval."""
    order = sorted(scores, key=lambda number: (number != raced.chosen, -raced.standings[number].n_seeds))
    for row, number in enumerate(order):
        standing = raced.standings[number]
        colour = ORANGE if number == raced.chosen else BLUE if number == CONTROL else GREY
        used = [-scores[number][seed] for seed in range(standing.n_seeds)]
        axes.scatter(used, [row] * len(used), color=colour, alpha=0.45, s=28)
        value, low, high = (-each for each in standing.estimate)
        axes.errorbar(
            value, row, xerr=[[value - high], [low - value]], color=colour, marker="D", markersize=6, capsize=3
        )
        outcome = "chosen" if number == raced.chosen else "not chosen"
        axes.annotate(
            f"{standing.n_seeds} seeds, {outcome}",
            (max(low, *used), row),
            (6, 0),
            textcoords="offset points",
            va="center",
            fontsize=8.5,
        )
    names = ["control" if number == CONTROL else f"trial {number}" for number in order]
    axes.set_yticks(range(len(order)), names)
    axes.set(title="2  Selection: validation volumes, new seeds", xlabel="steps, mean with 95 % interval")
    axes.set_xlim(right=axes.get_xlim()[1] + 1.1)
    axes.set_ylim(len(order) - 0.5, -0.5)


def draw_test(axes: Axes, ours: np.ndarray, theirs: np.ndarray, chosen: int) -> None:
    """Draw the difference of each seed, and of all with its interval."""
    difference, probability = paired_difference(ours, theirs), probability_of_improvement(-ours, -theirs)
    axes.axvline(0.0, color="#444", linewidth=1)
    of_seeds = (ours - theirs).mean(axis=1)
    axes.scatter(of_seeds, [0] * len(of_seeds), color=ORANGE, alpha=0.45, s=28)
    value, low, high = difference
    axes.errorbar(value, 0, xerr=[[value - low], [high - value]], color=ORANGE, marker="D", markersize=7, capsize=3)
    axes.annotate(
        f"{value:+.2f} ({low:+.2f} to {high:+.2f})", (value, 0), (0, 14), textcoords="offset points", ha="center"
    )
    axes.annotate(
        f"probability of improvement {probability.value:.0%}",
        (value, 0),
        (0, -22),
        textcoords="offset points",
        ha="center",
        bbox=PAPER,
    )
    axes.set(
        title="3  Test: test volumes, new seeds",
        xlabel=f"steps of trial {chosen} less those of the control",
        yticks=[],
        ylim=(-1, 1),
    )
    reach = 1.25 * max(abs(low), abs(high))
    axes.set_xlim(-reach, reach)
    axes.spines["left"].set_visible(False)


if __name__ == "__main__":
    main()
