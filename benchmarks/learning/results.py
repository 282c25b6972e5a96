"""Evaluate trained agents and baselines on unseen wrists.

    python -m benchmarks.learning.results [--data VOLUMES] [--folder RUNS] [--seeds 0 1 2] [--workers 2] [ROW ...]

A row is a preset (`conf/experiment`) or a baseline. Its training volumes are phantoms and all volumes of the folder; it
is run once for each seed, and judged in 300 episodes on 12 phantoms that it was not trained on, which are moved at each
reset, with 50 steps at most. The named rows (default: all) are run, `--workers` at a time, unless they have finished in
the folder of runs. Their figures are kept in `results.json` in that folder, and their table is printed. Without
`--data`, the table of the `results.json` beside this script is printed.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock

from benchmarks.arguments import count, parser_of, run_script
from benchmarks.learning.runs import MIXED, Run, add_folder, finished_run
from benchmarks.tables import print_head, print_row

FIGURES = "results.json"
TEST = "test volumes"
JUDGED = ["data.n_test=12", "evaluation.episodes=300"]
# Figure, digits and factor of each column.
COLUMNS = {
    "median, mm": ("median_distance_mm", 1, 1),
    "median, °": ("median_distance_deg", 1, 1),
    "mean steps": ("mean_steps", 2, 1),
    "success, %": ("success", 1, 100),
    "training, s": ("training_s", 0, 1),
    "mean steps\\*": ("mean_steps_not_started_solved", 2, 1),
    "success\\*, %": ("success_not_started_solved", 1, 100),
}


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Args:
        title: Title of the row.
        overrides: Overrides of the run.
        success: Required success rate; None for no requirement.
        mean_steps: Most mean steps allowed.
        minutes: Most minutes of training allowed.
    """

    title: str
    overrides: tuple[str, ...]
    success: float | None = None
    mean_steps: float | None = None
    minutes: float | None = None


def _presets() -> dict[str, Row]:
    wanted = {
        "best_y": ("y, SAC", 0.995, 1.3, 2),
        "best_zy": ("zy, SAC", 0.99, 1.8, 5),
        "best_full": ("full, SAC", 0.99, 1.8, 5),
        "best_ppo_y": ("y, PPO", 0.98, 2.5, 8),
        "best_ppo_zy": ("zy, PPO", 0.98, 2.5, 8),
        "best_ppo_full": ("full, PPO", 0.98, 2.5, 8),
        "best_full_exact": ("full, SAC, success threshold 0.01", 0.98, 3.0, 15),
        "best_full_images": ("full, images, SAC", 0.97, 3.0, 60),
        "best_zy_published_observation": ("zy, actions and rewards alone, SAC, sampling", 0.97, 6.0, 15),
        "best_full_distance": ("full, SAC, reward=agreement", None, None, None),
        "best_full_taught": ("full, trained on labelled planes, reward=agreement", None, None, None),
    }
    return {name: Row(title, (f"experiment={name}",), *limits) for name, (title, *limits) in wanted.items()}


def _baselines() -> dict[str, Row]:
    agents = {
        "random": ("random planes", ("agent=random",)),
        "exhaustive": ("5 mm sweep", ("agent=exhaustive",)),
        "tpe": ("TPE", ("agent=optuna", "agent.sampler=tpe")),
        "cmaes": ("CMA-ES", ("agent=optuna", "agent.sampler=cmaes")),
        "regression": ("regression", ("agent=regression",)),
    }
    tasks = {
        "y": ("y", ("projection=y",)),
        "zy": ("zy", ("projection=zy",)),
        "full": ("full", ("projection=full",)),
        "full_exact": ("full, success threshold 0.01", ("projection=full", "env.success_threshold=0.01")),
    }
    return {
        f"{agent}_{task}": Row(f"{of_task}, {of_agent}", (*agent_words, *task_words))
        for task, (of_task, task_words) in tasks.items()
        for agent, (of_agent, agent_words) in agents.items()
    }


ROWS = _presets() | _baselines()


def figures_of(run: Run) -> dict[str, float]:
    """Return the figures of a run that are kept."""
    judged = run.evaluations[TEST]
    episodes = judged["episodes"]
    return {
        "success": judged["metrics"]["success_rate"],
        "mean_steps": judged["metrics"]["mean_steps"],
        "success_not_started_solved": judged["metrics"]["success_rate_not_started_solved"],
        "mean_steps_not_started_solved": judged["metrics"]["mean_steps_not_started_solved"],
        "median_distance_mm": statistics.median(episode["distance_mm"] for episode in episodes),
        "median_distance_deg": statistics.median(episode["distance_deg"] for episode in episodes),
        "episodes": len(episodes),
        "training_s": run.training_s,
        "env_steps": run.n_env_steps,
    }


def measure(name: str, seed: int, data: str, folder: Path) -> None:
    """Run a row with a seed, unless that is done, and keep its figures."""
    overrides = [*ROWS[name].overrides, f"seed={seed}", *JUDGED]
    # Presets set their own number of phantoms.
    if not ROWS[name].overrides[0].startswith("experiment="):
        overrides.append("data.n_training=64")
    run = finished_run(f"{name}-seed{seed}", [*MIXED, f"data.path={data}", *overrides], folder)
    file = folder / FIGURES
    # Several processes may each measure some rows.
    with FileLock(f"{file}.lock"):
        kept = json.loads(file.read_text()) if file.exists() else {}
        kept.setdefault(name, {})[str(seed)] = figures_of(run)
        file.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n")


def print_tables(file: Path, rows: Collection[str]) -> None:
    """Print two tables of the figures in a file, for these rows: the figures of each seed, and the goals."""
    kept = json.loads(file.read_text())
    found = {name: [kept[name][seed] for seed in sorted(kept[name])] for name in ROWS if name in kept and name in rows}
    print_head("", *COLUMNS)
    for name, of_seeds in found.items():
        cells = (
            ", ".join(f"{factor * figures[figure]:.{digits}f}" for figures in of_seeds)
            for figure, digits, factor in COLUMNS.values()
        )
        print_row(f"{ROWS[name].title} (`{name}`)", *cells)
    print()
    print_head("", "success", "mean steps", "training", "reached by")
    for name, of_seeds in found.items():
        _print_goal(name, ROWS[name], of_seeds)


def _print_goal(name: str, row: Row, of_seeds: list[dict[str, float]]) -> None:
    if row.success is None or row.mean_steps is None or row.minutes is None:
        return
    reached = sum(
        figures["success"] >= row.success
        and figures["mean_steps"] <= row.mean_steps
        and figures["training_s"] <= 60 * row.minutes
        for figures in of_seeds
    )
    goal = f"≥ {100 * row.success:g} %", f"≤ {row.mean_steps:g}", f"≤ {row.minutes:g} min"
    print_row(f"`{name}`", *goal, f"{reached} of {len(of_seeds)} seeds")


def main() -> None:
    """Measure the chosen rows, if volumes are given, and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"default: all of {', '.join(ROWS)}")
    parser.add_argument("--data", help="folder of volumes; without it, only the table is printed")
    parser.add_argument("--seeds", type=int, nargs="+", default=(0, 1, 2), help="default: 0 1 2")
    parser.add_argument("--workers", type=count, default=2, help="default: %(default)s")
    add_folder(parser)
    given = parser.parse_args()
    if unknown := [name for name in given.rows if name not in ROWS]:
        parser.error(f"{unknown[0]!r} is none of {', '.join(ROWS)}")
    rows = given.rows or [*ROWS]
    if given.data:
        with ThreadPoolExecutor(given.workers) as pool:
            waiting = [
                pool.submit(measure, name, seed, given.data, given.folder) for name in rows for seed in given.seeds
            ]
            for each in waiting:
                each.result()
    print_tables(given.folder / FIGURES if given.data else Path(__file__).with_name(FIGURES), rows)


if __name__ == "__main__":
    run_script(main)
