"""Evaluate trained agents and baselines on unseen wrists.

    python -m benchmarks.learning.results data=VOLUMES [folder=RUNS] [seeds=0,1,2] [workers=2] [ROW ...]
    python -m benchmarks.learning.results show

A row is a preset (`conf/experiment`) or a baseline. Its training volumes are phantoms and all volumes of the folder; it
is run once for each seed, and judged in 300 episodes on 12 phantoms that it was not trained on, which are moved at each
reset, with 50 steps at most. The named rows (default: all) are run, `workers` at a time, unless they have finished in
the folder of runs. Their figures are kept in `results.json` beside this script, and the table is printed. `show` only
prints it.
"""

from __future__ import annotations

import json
import statistics
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock

from benchmarks.learning.runs import MIXED, Run, finished_run

FIGURES = Path(__file__).with_name("results.json")
TEST = "test volumes"
JUDGED = ["data.n_test=12", "evaluation.episodes=300"]


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
        "best_y": ("1-DoF (y), SAC", 0.995, 1.3, 2),
        "best_zy": ("2-DoF (zy), SAC", 0.99, 1.8, 5),
        "best_full": ("4-DoF (full), SAC", 0.99, 1.8, 5),
        "best_ppo_y": ("1-DoF (y), PPO", 0.98, 2.5, 8),
        "best_ppo_zy": ("2-DoF (zy), PPO", 0.98, 2.5, 8),
        "best_ppo_full": ("4-DoF (full), PPO", 0.98, 2.5, 8),
        "best_full_exact": ("4-DoF, SAC, success threshold 0.01", 0.98, 3.0, 15),
        "best_full_images": ("4-DoF, images alone, SAC", 0.97, 3.0, 60),
        "best_zy_published_observation": ("2-DoF, actions and rewards alone, SAC, sampling", 0.97, 6.0, 15),
        "best_full_distance": ("4-DoF, SAC, reward=agreement", None, None, None),
        "best_full_taught": ("4-DoF, taught with labelled planes, reward=agreement", None, None, None),
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
        "y": ("1-DoF", ("projection=y",)),
        "zy": ("2-DoF", ("projection=zy",)),
        "full": ("4-DoF", ("projection=full",)),
        "full_exact": ("4-DoF, success threshold 0.01", ("projection=full", "env.success_threshold=0.01")),
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
    # Several processes may each measure some rows.
    with FileLock(f"{FIGURES}.lock"):
        kept = json.loads(FIGURES.read_text()) if FIGURES.exists() else {}
        kept.setdefault(name, {})[str(seed)] = figures_of(run)
        FIGURES.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n")


def table() -> str:
    """Return two Markdown tables of all kept figures: the figures of each seed, and the goals."""
    kept = json.loads(FIGURES.read_text())
    lines = [
        "| | median, mm | median, ° | mean steps | success, % | training, s | mean steps\\* | success\\*, % |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    goals = ["| | success | mean steps | training | reached by |", "| --- | --- | --- | --- | --- |"]
    for name, row in ROWS.items():
        if name in kept:
            of_seeds = [kept[name][seed] for seed in sorted(kept[name])]
            cells = [
                f"{row.title} (`{name}`)",
                _joined(of_seeds, "median_distance_mm", "{:.1f}"),
                _joined(of_seeds, "median_distance_deg", "{:.1f}"),
                _joined(of_seeds, "mean_steps", "{:.2f}"),
                _joined(of_seeds, "success", "{:.1f}", 100),
                _joined(of_seeds, "training_s", "{:.0f}"),
                _joined(of_seeds, "mean_steps_not_started_solved", "{:.2f}"),
                _joined(of_seeds, "success_not_started_solved", "{:.1f}", 100),
            ]
            lines.append("| " + " | ".join(cells) + " |")
            goals += _goal(name, row, of_seeds)
    return "\n".join([*lines, "", *goals])


def _joined(of_seeds: list[dict[str, float]], figure: str, form: str, factor: float = 1.0) -> str:
    return ", ".join(form.format(factor * figures[figure]) for figures in of_seeds)


def _goal(name: str, row: Row, of_seeds: list[dict[str, float]]) -> list[str]:
    if row.success is None or row.mean_steps is None or row.minutes is None:
        return []
    reached = sum(
        figures["success"] >= row.success
        and figures["mean_steps"] <= row.mean_steps
        and figures["training_s"] <= 60 * row.minutes
        for figures in of_seeds
    )
    goal = f"≥ {100 * row.success:g} % | ≤ {row.mean_steps:g} | ≤ {row.minutes:g} min"
    return [f"| `{name}` | {goal} | {reached} of {len(of_seeds)} seeds |"]


def main(words: list[str]) -> None:
    """Measure and show what the words ask for."""
    given = dict(word.split("=", 1) for word in words if "=" in word)
    names = [word for word in words if "=" not in word and word != "show"]
    if (unknown := [name for name in names if name not in ROWS]) or given.keys() - {
        "data",
        "folder",
        "seeds",
        "workers",
    }:
        sys.exit(f"{' '.join(unknown) or given}: see the text at the head of {__file__}; rows: {' '.join(ROWS)}")
    if "show" not in words:
        if "data" not in given:
            sys.exit(f"give data=FOLDER, or show: see the text at the head of {__file__}")
        folder = Path(given.get("folder", "benchmark-runs"))
        folder.mkdir(parents=True, exist_ok=True)
        seeds = [int(seed) for seed in given.get("seeds", "0,1,2").split(",")]
        with ThreadPoolExecutor(int(given.get("workers", "2"))) as pool:
            waiting = [
                pool.submit(measure, name, seed, given["data"], folder) for name in names or ROWS for seed in seeds
            ]
            for each in waiting:
                each.result()
    print(table())


if __name__ == "__main__":
    main(sys.argv[1:])
