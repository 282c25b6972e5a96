"""Repeat the published experiments, and draw their learning curves over the published ones.

    python -m benchmarks.learning.published [--full] [--folder RUNS] [--data VOLUMES] [NAME ...]

Each training stops after a few minutes; with `--full`, it takes the environment steps of the preset, hours for two
degrees of freedom. NAMEs of presets, such as `published_sac_y_8`, run only these. Given a folder of volumes, runs
train on its first 1, 2 or 8, otherwise on as many phantoms. A run that has finished in the folder of runs is not
repeated.

The published runs (2024, on real wrists, 80 cores and a V100) logged the mean length of the episodes that ended in each
collection, while exploring. Ours log the same as `train/length`, for each epoch. A published episode could be one step
too long. "Reached" is the first step at which the mean of five successive points is at or below a length; the published
clock starts at its first point.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from benchmarks.arguments import parser_of, run_script
from benchmarks.learning.runs import MIXED, add_folder, finished_run
from benchmarks.repository import PICTURES
from benchmarks.tables import print_head, print_row

HERE = Path(__file__).parent
LENGTHS = (10, 5, 2)
TICKS = (1, 2, 5, 10, 20, 50, 100)
N_SMOOTHED = 5


@dataclass(frozen=True)
class Published:
    """A published experiment.

    Args:
        title: Title of its panel.
        reference: Name of the published curve.
        n_volumes: Number of training volumes.
        small_env_steps: Environment steps of the small run.
        ours: Our preset that is drawn beside it.
    """

    title: str
    reference: str
    n_volumes: int
    small_env_steps: int
    ours: str


SAC = "run-sac-characteristic-array"
EXPERIMENTS = {
    "published_sac_y_1": Published("SAC, y, 1 volume", f"{SAC}-rew-details-y_42_20240628-183630", 1, 15_000, "best_y"),
    "published_sac_y_2": Published("SAC, y, 2 volumes", f"{SAC}-rew-details-y_42_20240630-191219", 2, 15_000, "best_y"),
    "published_sac_y_8": Published("SAC, y, 8 volumes", f"{SAC}-rew-details-y_42_20240722-162357", 8, 15_000, "best_y"),
    "published_sac_zy_2": Published(
        "SAC, zy, 2 volumes", f"{SAC}-rew-details-zy_42_20240714-111101", 2, 24_000, "best_zy"
    ),
    "published_sac_zy_8": Published(
        "SAC, zy, 8 volumes", f"{SAC}-rew-details-zy_42_20240724-070219", 8, 24_000, "best_zy"
    ),
    "published_sac_y_memory": Published(
        "SAC, y, actions and rewards alone", f"{SAC}-4-rew-details-y_42_20240801-205846", 8, 15_000, "best_y"
    ),
    "published_sac_zy_memory": Published(
        "SAC, zy, actions and rewards alone",
        f"{SAC}-4-rew-details-zy_20240803-141214",
        8,
        24_000,
        "best_zy_published_observation",
    ),
    "published_ppo_channels": Published(
        "PPO, images", "run-ppo_42_4_stack-lin_sweep_v1_20240611-161932", 1, 16_000, "best_y"
    ),
}
RANDOM = "run-random-actions_42_20240814-155108"


@dataclass(frozen=True)
class Curve:
    """Mean lengths of episodes.

    Args:
        steps: Environment steps, shape (n,).
        lengths: Mean steps of the episodes that have ended, shape (n,).
        seconds: Seconds since the training began, shape (n,).
    """

    steps: np.ndarray
    lengths: np.ndarray
    seconds: np.ndarray

    def smoothed(self) -> np.ndarray:
        """Means of each point and up to four before it, shape (n,)."""
        return np.array([self.lengths[max(0, i + 1 - N_SMOOTHED) : i + 1].mean() for i in range(len(self.lengths))])

    def reached(self, length: float) -> tuple[int, float] | None:
        """Environment steps and seconds until the smoothed length is at most `length`; None if it never is."""
        below = np.flatnonzero(self.smoothed()[N_SMOOTHED - 1 :] <= length)
        if not len(below):
            return None
        first = below[0] + N_SMOOTHED - 1
        return int(self.steps[first]), float(self.seconds[first])


def published_curve(reference: str) -> Curve:
    """Read a published curve."""
    with (HERE / "reference" / f"{reference}-tag-train_lens_stat_mean.csv").open() as file:
        rows = list(csv.DictReader(file))
    wall_s = np.array([float(row["Wall time"]) for row in rows])
    return Curve(
        np.array([int(row["Step"]) for row in rows]),
        np.array([float(row["Value"]) for row in rows]),
        wall_s - wall_s[0],
    )


def our_curve(name: str, overrides: list[str], folder: Path) -> Curve:
    """Run a preset and return its curve."""
    curve = finished_run(name, overrides, folder).curve
    seconds = dict(curve["wall_s"])
    steps, lengths = np.array(curve["train/length"]).T
    return Curve(steps.astype(int), lengths, np.array([seconds[int(step)] for step in steps]))


def curves(name: str, *, is_full: bool, volumes: str | None, folder: Path) -> dict[str, Curve]:
    """Return the published curve, ours with the same settings, and that of our preset, by their labels."""
    experiment = EXPERIMENTS[name]
    data = (
        [f"data.n_training={experiment.n_volumes}"]
        if volumes is None
        else [*MIXED, f"data.path={volumes}", f"data.n_volumes={experiment.n_volumes}", "data.n_training=0"]
    )
    steps = [] if is_full else [f"training.env_steps={experiment.small_env_steps}"]
    size = "full" if is_full else "small"
    same = our_curve(f"{name}-{size}", [f"experiment={name}", *data, *steps], folder)
    ours = our_curve(experiment.ours, [f"experiment={experiment.ours}"], folder)
    return {
        "published": published_curve(experiment.reference),
        "the same settings": same,
        experiment.ours: ours,
    }


def draw(found: dict[str, dict[str, Curve]], path: Path) -> None:
    """Draw a panel for each experiment."""
    n_columns = min(4, len(found))
    n_rows = -(-len(found) // n_columns)
    figure = Figure(figsize=(4.2 * n_columns, 3.3 * n_rows), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    at_random = float(np.mean(published_curve(RANDOM).lengths))
    for panel, (name, of_name) in zip(panels, found.items(), strict=False):
        for (label, curve), colour in zip(of_name.items(), ("tab:grey", "tab:orange", "tab:blue"), strict=True):
            panel.plot(curve.steps, curve.lengths, color=colour, alpha=0.25, linewidth=0.8)
            panel.plot(curve.steps, curve.smoothed(), color=colour, label=label)
        panel.axhline(at_random, color="black", linestyle=":", linewidth=0.8, label="published, random planes")
        panel.set(title=EXPERIMENTS[name].title, xscale="log", yscale="log", xlabel="environment steps")
        panel.set_ylabel("mean steps an episode")
        panel.set_yticks(TICKS, [str(tick) for tick in TICKS])
        panel.yaxis.set_minor_formatter(NullFormatter())
        panel.grid(alpha=0.3, which="both")
        panel.legend(fontsize=7)
    for panel in panels[len(found) :]:
        panel.remove()
    figure.savefig(path, dpi=110)


def print_table(found: dict[str, dict[str, Curve]]) -> None:
    """Print the steps and the time to reach each length."""
    print_head("experiment", "curve", *(f"length {length}" for length in LENGTHS))
    for name, of_name in found.items():
        for label, curve in of_name.items():
            is_known = len(curve.lengths) >= N_SMOOTHED
            cells = (_reached(curve.reached(length)) if is_known else "too few points" for length in LENGTHS)
            print_row(EXPERIMENTS[name].title, label, *cells)


def _reached(when: tuple[int, float] | None) -> str:
    if when is None:
        return "never"
    steps, seconds = when
    time = (
        f"{seconds:.0f} s"
        if seconds < 120
        else f"{seconds / 60:.0f} min"
        if seconds < 7200
        else f"{seconds / 3600:.1f} h"
    )
    return f"{steps:,} steps, {time}"


def main() -> None:
    """Run, draw and print the chosen experiments."""
    parser = parser_of(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="preset (default: all)")
    parser.add_argument("--full", action="store_true", help="take all environment steps of the preset")
    parser.add_argument("--data", help="folder of volumes (default: phantoms)")
    add_folder(parser)
    given = parser.parse_args()
    if unknown := [name for name in given.names if name not in EXPERIMENTS]:
        parser.error(f"{unknown[0]!r} is none of {', '.join(EXPERIMENTS)}")
    names, folder = given.names or list(EXPERIMENTS), given.folder
    found = {name: curves(name, is_full=given.full, volumes=given.data, folder=folder) for name in names}
    picture = (PICTURES if len(names) == len(EXPERIMENTS) else folder) / "published.png"
    draw(found, picture)
    print_table(found)
    print(f"picture: {picture}")


if __name__ == "__main__":
    run_script(main)
