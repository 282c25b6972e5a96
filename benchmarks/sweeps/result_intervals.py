"""Simulate how often the interval of a study's result contains the true difference, compared with other intervals.

    python -m benchmarks.sweeps.result_intervals [--studies 2000]

A simulated study has four candidates and the control. The score of a training on a volume is the sum of its
configuration's true value, an effect of the training, an effect of the configuration on the volume, and a residual, all
normal. `armscan.sweeps.scheduling.race` selects the configuration. The table counts the studies that do not choose the
control: the share whose 95 % interval of chosen minus control contains the true difference.

- `paired`: as armscan tests, with new seeds and `armscan.stats.paired`;
- `bootstrap`: new seeds, and a percentile bootstrap over seeds;
- `improvement`: the interval of the probability of improvement, instead of the difference.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from armscan.stats.aggregation import probability_of_improvement
from armscan.stats.bootstrap import LOWER, N_RESAMPLES, UPPER
from armscan.stats.paired import crossed_mean
from armscan.sweeps.scheduling.race import MAX_SEEDS_FACTOR, race
from benchmarks.arguments import count, parser_of, run_script
from benchmarks.tables import print_head, print_row

N_CANDIDATES, N_VALIDATION, MIN_SEEDS, MEAN_SEEDS = 4, 8, 2, 12
MAX_SEEDS = MAX_SEEDS_FACTOR * MEAN_SEEDS
# Standard deviations of the effects of trainings, of the effects of configurations on volumes, and of the residuals.
OF_SEEDS, OF_VOLUMES, REST = 1.0, 0.4, 0.5
# Standard deviation of the difference between two trainings on a volume.
OF_DIFFERENCE = (2 * (OF_SEEDS**2 + OF_VOLUMES**2 + REST**2)) ** 0.5
N_SEEDS, N_VOLUMES, EFFECTS = (2, 3, 5, 10), (4, 8, 12), (0.0, 1.0)


class Coverage(NamedTuple):
    """Shares of the studies whose interval contains the truth, for each interval of the module's docstring."""

    paired: float
    improvement: float
    bootstrap: float
    n_studies: int
    n_trainings: float


def simulate(n_studies: int, n_seeds: int, n_volumes: int, effect: float) -> Coverage:
    """Simulate studies.

    Args:
        n_studies: Number of studies.
        n_seeds: Seeds of the test.
        n_volumes: Test volumes.
        effect: Standard deviation of the true values of the candidates, around that of the control.
    """
    rng = np.random.default_rng(0)
    n_configurations = N_CANDIDATES + 1
    true = np.c_[np.zeros(n_studies), effect * rng.standard_normal((n_studies, N_CANDIDATES))]

    def trained(n: int) -> np.ndarray:
        return OF_SEEDS * rng.standard_normal((n_studies, n_configurations, n))

    def played(trainings: np.ndarray, n: int) -> np.ndarray:
        """Scores of trainings on other volumes, shape (studies, configurations, seeds, volumes)."""
        of_volumes = OF_VOLUMES * rng.standard_normal((n_studies, n_configurations, 1, n))
        rest = REST * rng.standard_normal((*trainings.shape, n))
        return true[..., None, None] + trainings[..., None] + of_volumes + rest

    selecting, testing = trained(MAX_SEEDS), trained(n_seeds)
    scores, own = played(selecting, N_VALIDATION).mean(axis=-1), played(testing, n_volumes)
    held, n_trainings = [], 0
    for study, table in enumerate(scores):
        by_seed = {number: dict(enumerate(row)) for number, row in enumerate(table)}
        raced = race(by_seed, range(MAX_SEEDS), min_seeds=MIN_SEEDS, mean_seeds=MEAN_SEEDS)
        chosen = raced.chosen
        n_trainings += sum(standing.n_seeds for standing in raced.standings.values())
        if not chosen:
            continue
        truth = true[study, chosen] - true[study, 0]
        differences = own[study, chosen] - own[study, 0]
        drawn = rng.choice(differences.mean(axis=-1), size=(N_RESAMPLES, n_seeds)).mean(axis=1)
        low, high = np.quantile(drawn, (LOWER, UPPER))
        improvement = probability_of_improvement(own[study, chosen], own[study, 0])
        held.append(
            (
                holds(differences, truth),
                bool(improvement.low <= ndtr(truth / OF_DIFFERENCE) <= improvement.high),
                bool(low <= truth <= high),
            )
        )
    return Coverage(*np.mean(held, axis=0), len(held), n_trainings / n_studies)


def holds(differences: np.ndarray, truth: float) -> bool:
    """Return whether the interval of a paired difference contains the truth."""
    mean, half = crossed_mean(differences)
    return bool(abs(mean - truth) <= half)


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--studies", type=count, default=2000, help="default: %(default)s")
    n_studies = parser.parse_args().studies
    intervals = "difference", "probability of improvement", "percentile bootstrap of the seeds"
    names = *intervals, "studies", "trainings to select"
    print_head("seeds", "test volumes", "effect", *names)
    for n_seeds, n_volumes, effect in product(N_SEEDS, N_VOLUMES, EFFECTS):
        found = simulate(n_studies, n_seeds, n_volumes, effect)
        shares = (f"{share:.1%}" for share in found[:3])
        print_row(n_seeds, n_volumes, effect, *shares, found.n_studies, f"{found.n_trainings:.1f}")


if __name__ == "__main__":
    run_script(main)
