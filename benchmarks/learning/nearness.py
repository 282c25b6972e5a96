"""Measure how near the labelled plane the agents of runs come, and compare that with the error they expect.

    python -m benchmarks.learning.nearness RUN [FOLDER | phantom] [--tracking URI] [--episodes N] [--rx DEG]
                                           [--averaged N]
    python -m benchmarks.learning.nearness GRID ...

Prints medians and 90th percentiles of distance and angle, and how often both are below 1.5 mm and 4 degrees, over all
volumes and for each. For an agent that estimates its own error (`agent=plane_finder`), also prints the errors by decile
of that estimate. Volumes: a folder, or 12 phantoms that no run trains on; default: the run's own test volumes. A grid
(`data.folds`) plays all of its runs, each on its own test volumes. `--rx` turns volumes by up to that many degrees
about the axis across, as `env.transform.rx_deg` does. `--averaged` sets `agent.n_averaged`, which changes no gradient
step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from omegaconf import OmegaConf

from armscan.config.defaults import PHANTOM, default_tracking
from armscan.evaluation.agent_source import agent_of_run
from armscan.evaluation.runner import prepare_agent
from armscan.tracking import find_run, open_existing_store
from armscan.tracking.tags import AGENT_TAG
from armscan.training import TEST, evaluate
from armscan.training.episode_results import EpisodeResult
from armscan.training.episode_seeds import EVALUATION_SEED
from benchmarks.arguments import count, parser_of, run_script
from benchmarks.tables import print_head, print_row

N_PHANTOMS, N_GROUPS = 12, 10
NEAR_MM, NEAR_DEG = 1.5, 4.0


def runs_of(tracking: str, run_id: str) -> list[str]:
    """Return the IDs of a grid's runs; for a single run, its own ID."""
    store = open_existing_store(tracking)
    run = find_run(store, run_id)
    children = store.children(run.info.experiment_id, run.info.run_id)
    return [child.info.run_id for child in children if AGENT_TAG in child.data.tags] or [run.info.run_id]


def played(
    tracking: str, run_id: str, data: str | None, n_episodes: int, changes: Mapping[str, float | None]
) -> list[EpisodeResult]:
    """Return the episodes of a run's agent on the volumes; changes to its configuration that are None do not count."""
    subject = agent_of_run(tracking, run_id, {})
    for key, value in changes.items():
        if value is not None:
            OmegaConf.update(subject.config, key, value, force_add=True)
    prepared = prepare_agent(subject, data, N_PHANTOMS)
    label = data if data == PHANTOM else TEST
    env = prepared.envs.get(label, list(prepared.envs.values())[-1])
    return list(evaluate(prepared.agent, env, n_episodes=n_episodes, seed=EVALUATION_SEED).episodes)


def print_errors(name: str, episodes: Sequence[EpisodeResult]) -> None:
    """Print a row of the table for some episodes."""
    errors = np.array([(each.distance_mm, each.distance_deg) for each in episodes])
    (mm, deg), (mm_90, deg_90) = np.median(errors, axis=0), np.percentile(errors, 90, axis=0)
    near = (errors < (NEAR_MM, NEAR_DEG)).all(axis=1).mean()
    success = np.mean([each.is_success for each in episodes])
    figures = f"{mm:.2f} / {mm_90:.1f}", f"{deg:.1f} / {deg_90:.1f}", f"{100 * near:.0f}", f"{100 * success:.0f}"
    print_row(name, len(episodes), *figures)


def print_expected_errors(episodes: Sequence[EpisodeResult]) -> None:
    """Print the errors by decile of the expected error, if the episodes have one."""
    for unit in ("mm", "deg"):
        expected = np.array([getattr(each, f"expected_{unit}") for each in episodes], dtype=float)
        if np.isnan(expected).any():
            return
        errors = np.array([getattr(each, f"distance_{unit}") for each in episodes])
        print(f"correlation of expected and real error, {unit}: {np.corrcoef(expected, errors)[0, 1]:.2f}")
        for k, chosen in enumerate(np.array_split(expected.argsort(), N_GROUPS)):
            name = f"decile {k + 1} of expected {unit}, {expected[chosen].mean():.2f}"
            print_errors(name, [episodes[index] for index in chosen])


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("run")
    parser.add_argument("data", nargs="?")
    parser.add_argument("--tracking", default=default_tracking()["uri"])
    parser.add_argument("--episodes", type=count, default=300)
    parser.add_argument("--rx", type=float)
    parser.add_argument("--averaged", type=int)
    given = parser.parse_args()
    run_ids = runs_of(given.tracking, given.run)
    n_each = -(-given.episodes // len(run_ids))
    changes = {"env.transform.rx_deg": given.rx, "agent.n_averaged": given.averaged}
    episodes = [each for run_id in run_ids for each in played(given.tracking, run_id, given.data, n_each, changes)]
    errors = "mm, median / p90", "degrees, median / p90", "both < 1.5 mm and < 4 degrees, %"
    print_head("", "episodes", *errors, "success, %")
    print_errors("all", episodes)
    for name in dict.fromkeys(each.volume for each in episodes):
        print_errors(name, [each for each in episodes if each.volume == name])
    print_expected_errors(episodes)


if __name__ == "__main__":
    run_script(main)
