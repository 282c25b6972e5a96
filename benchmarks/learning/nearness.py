"""How near the labelled plane the agent of a run comes, and what its own doubt says of it.

    python -m benchmarks.learning.nearness RUN [FOLDER | phantom] [--tracking URI] [--episodes N]

Medians and 90th percentiles of the distance and the angle, how often both are within 1.5 mm and 4 degrees, over all
volumes and for each; and, for an agent that says how far off it expects to be (`agent=plane_finder`), the errors by
quintile of that. Volumes: a folder, or 12 phantoms that no run trains on; default: the run's own test volumes.
"""

from __future__ import annotations

import argparse

import numpy as np

from armscan.config.defaults import PHANTOM, default_tracking
from armscan.evaluation.agent_source import agent_of_run
from armscan.evaluation.runner import FIRST_SEED, apply
from armscan.training import TEST
from armscan.training.episodes import play

N_PHANTOMS, N_QUINTILES = 12, 5
NEAR_MM, NEAR_DEG = 1.5, 4.0


def measured(agent, env, n_episodes: int) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return the volumes of episodes, their errors and the expected ones (else NaN), shape (n, 2), mm and degrees."""
    names = list(env.get_wrapper_attr("volumes"))
    volumes = [names[i % len(names)] for i in range(n_episodes)]
    errors, expected = [], []
    for i, name in enumerate(volumes):
        episode = play(agent, env, name, FIRST_SEED + i)
        errors.append((episode.distance_mm, episode.distance_deg))
        expected.append(getattr(agent, "expected_error", None) or (np.nan, np.nan))
    return volumes, np.array(errors), np.array(expected)


def print_row(name: str, errors: np.ndarray) -> None:
    """Print a row of the table for some episodes."""
    (mm, deg), (mm_90, deg_90) = np.median(errors, axis=0), np.percentile(errors, 90, axis=0)
    near = (errors < (NEAR_MM, NEAR_DEG)).all(axis=1).mean()
    print(f"| {name} | {len(errors)} | {mm:.2f} / {mm_90:.1f} | {deg:.1f} / {deg_90:.1f} | {100 * near:.0f} |")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("data", nargs="?")
    parser.add_argument("--tracking", default=default_tracking()["uri"])
    parser.add_argument("--episodes", type=int, default=300)
    given = parser.parse_args()
    prepared = apply(agent_of_run(given.tracking, given.run, {}), given.data, N_PHANTOMS)
    label = given.data if given.data == PHANTOM else TEST
    env = prepared.envs.get(label, list(prepared.envs.values())[-1])
    volumes, errors, expected = measured(prepared.agent, env, given.episodes)
    print("| | episodes | mm, median / p90 | degrees, median / p90 | both < 1.5 mm and < 4 degrees, % |")
    print("| --- | --- | --- | --- | --- |")
    print_row("all", errors)
    for name in dict.fromkeys(volumes):
        print_row(name, errors[np.array(volumes) == name])
    if np.isnan(expected).any():
        return
    for i, unit in enumerate(("mm", "degrees")):
        print(f"correlation of expected and real error, {unit}: {np.corrcoef(expected[:, i], errors[:, i])[0, 1]:.2f}")
        for k, chosen in enumerate(np.array_split(expected[:, i].argsort(), N_QUINTILES)):
            print_row(f"quintile {k + 1} of expected {unit}, {expected[chosen, i].mean():.2f}", errors[chosen])


if __name__ == "__main__":
    main()
