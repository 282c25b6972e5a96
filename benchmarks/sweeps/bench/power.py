"""Compute how many seeds a comparison of two settings needs, by their true difference."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.stats import ttest_ind

from armscan.utils.arrays import FloatArray
from benchmarks.sweeps.bench.surrogate import Surrogate

N_SEEDS = (2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 30, 50)
# Relative differences in mean steps; 0 gives the false positives.
DIFFERENCES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
# Good configurations take at most this multiple of the steps of the best, and the best are this share of all.
GOOD, BEST = 2.0, 0.1
N_COMPARISONS = 4000
LEVEL, POWER = 0.05, 0.8


def power_of(residuals: FloatArray, n_comparisons: int = N_COMPARISONS) -> pd.DataFrame:
    """Return how often a difference is detected, by its size (rows) and by the seeds of each setting (columns).

    A difference is detected if Welch's t test of the logarithms of the mean steps is significant at 5 %.

    Args:
        residuals: Differences of trainings from the mean of their configuration, as logarithms; both settings draw
            from them.
        n_comparisons: Comparisons of each size and number of seeds. Default: 4,000.
    """
    rng = np.random.default_rng(0)
    power = {}
    for n_seeds in N_SEEDS:
        ours, theirs = rng.choice(residuals, size=(2, n_comparisons, n_seeds))
        power[n_seeds] = [
            float((ttest_ind(ours, theirs + np.log1p(each), axis=1, equal_var=False).pvalue < LEVEL).mean())
            for each in DIFFERENCES
        ]
    return pd.DataFrame(power, index=pd.Index(DIFFERENCES, name="difference"))


def needed_seeds(power: pd.DataFrame) -> dict[float, int | None]:
    """Return the fewest seeds that detect each difference in 80 % of comparisons; None if even the most do not."""
    enough = power >= POWER
    return {float(each): int(row.idxmax()) if row.any() else None for each, row in enough.iterrows() if each > 0}


def residuals_of(surrogate: Surrogate) -> dict[str, FloatArray]:
    """Return the test residuals of the trainings of good configurations, and of the best, as logarithms.

    Nobody compares bad ones, and the noise between seeds depends on the configuration. Whether a configuration counts
    for a training is decided without that training: otherwise, configurations with a bad seed would be left out.
    """
    means, config_of, residuals = surrogate.means[:, -1], surrogate.config_of, surrogate.residuals[:, -1]
    n_seeds = np.bincount(config_of)[config_of]
    # The residuals are differences from the mean, scaled by the root of n / (n - 1).
    of_others = means[config_of] - residuals / np.sqrt(n_seeds * (n_seeds - 1))
    ends = {
        f"configurations with at most {GOOD:.0f} times the steps of the best": means.min() + np.log(GOOD),
        f"the best {BEST:.0%} of the configurations": np.quantile(means, BEST),
    }
    return {name: residuals[of_others <= end] for name, end in ends.items()}
