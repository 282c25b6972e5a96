"""Trainings of any configuration, simulated from the table: the mean by a forest, residuals from real trainings.

A table alone has too few points for a sampler to search: replacing each proposal by the nearest of them would handicap
samplers, most of all those that search locally (Pfisterer et al. 2022, YAHPO Gym). So extremely randomised trees
(Geurts et al. 2006) weight the configurations of the table (Meinshausen 2006), and the mean curve of a configuration is
the weighted mean of their curves; a configuration of the table keeps its own. A training adds the residuals of one real
training, drawn with the same weights: its differences from the mean of its own configuration, in all epochs, the
selection and the test at once, so that they are as large, as skewed and as persistent as in the table. All of this is
on the logarithm of the mean steps of an episode. The true value of a configuration is then known: the mean over all
trainings that could be drawn.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr
from sklearn.ensemble import ExtraTreesRegressor

from armscan.sweeps.space.space import Space
from armscan.utils.arrays import FloatArray
from benchmarks.sweeps.bench.design import places_of, sobol, values_at
from benchmarks.sweeps.bench.table import Curves

N_TREES, N_FOLDS = 100, 10
# Place of the selection among the epochs, the selection and the test.
SELECTION_PART = -2
# Points among which the best of the space is searched, a power of 2.
N_PLACES = 2048


class Training(NamedTuple):
    """A simulated training.

    Args:
        curve: Mean steps in the validation of each epoch, shape (epochs,).
        selection: Mean steps of the best epoch's weights on the validation volumes, in episodes that did not select
            weights.
        test: The same on the test volumes.
    """

    curve: FloatArray
    selection: float
    test: float


@dataclass(frozen=True)
class Surrogate:
    """A model of the mean steps of an episode in each epoch's validation, and in the selection and the test at the end.

    Args:
        space: Search space of the sweep.
        env_steps: Environment steps at the end of each epoch, shape (epochs,).
        low: Lower corner of the box of each tree's leaf that each configuration is in, shape
            (trees, configurations, dimensions); NaN for a configuration that is left out.
        high: Upper corner of that box, likewise.
        share: Inverse of the number of configurations in that box, shape (trees, configurations).
        means: Mean logarithm of each configuration's epochs, selection and test, shape (configurations, epochs + 2).
        residuals: Difference of each training from that mean, shape (trainings, epochs + 2).
        config_of: Configuration of each training, shape (trainings,).
        bounds: Smallest and largest logarithm of the table.
    """

    space: Space
    env_steps: FloatArray
    low: FloatArray
    high: FloatArray
    share: FloatArray
    means: FloatArray
    residuals: FloatArray
    config_of: NDArray[np.intp]
    bounds: tuple[float, float]

    @classmethod
    def of(cls, curves: Curves, *, without: int | None = None, seed: int = 0) -> Surrogate:
        """Return the model of a table.

        Args:
            curves: Table of the trainings.
            without: Fold of the configurations that is left out. Default: None, no fold.
            seed: Seed of the forest. Default: 0.
        """
        parts = curves.validation, curves.selection, curves.test
        logs = np.log(np.column_stack([part["mean_steps"] for part in parts]))
        means, residuals = centred(logs, curves.config_of)
        places = curves.places()
        is_in = np.arange(len(places)) % N_FOLDS != (-1 if without is None else without)
        forest = ExtraTreesRegressor(N_TREES, random_state=seed).fit(places[is_in], means[is_in])
        corners = [_boxes(tree.tree_) for tree in forest.estimators_]
        leaves = forest.apply(places).T
        low, high = (
            np.array([of_tree[end][of_places] for of_tree, of_places in zip(corners, leaves, strict=True)])
            for end in (0, 1)
        )
        low[:, ~is_in] = np.nan
        share = np.array([1.0 / np.bincount(each[is_in], minlength=each.max() + 1)[each] for each in leaves])
        bounds = float(logs.min()), float(logs.max())
        return cls(curves.space, curves.env_steps, low, high, share, means, residuals, curves.config_of, bounds)

    def weights(self, places: FloatArray) -> FloatArray:
        """Return the weight of each configuration of the table at points, shape (places, configurations)."""
        # Much faster than the forest's own method, which takes milliseconds for one point.
        are_in = (((place > self.low) & (place <= self.high)).all(axis=-1) for place in places)
        return np.array([(self.share * is_in).sum(axis=0) for is_in in are_in]) / len(self.share)

    def config(self, values: Mapping[str, Any]) -> SimulatedConfig:
        """Return the simulation of a configuration, given by its values by name."""
        (weights,) = self.weights(np.array([places_of(self.space, values)]))
        n_seeds = np.bincount(self.config_of)
        return SimulatedConfig(self, weights @ self.means, (weights / n_seeds)[self.config_of])

    def truth(self, places: FloatArray) -> FloatArray:
        """Return the mean steps on the test volumes over all trainings that could be drawn, shape (places,)."""
        weights, n_seeds = self.weights(places), np.bincount(self.config_of)
        logs = (weights @ self.means[:, -1])[:, np.newaxis] + self.residuals[:, -1]
        drawn = (weights / n_seeds)[:, self.config_of]
        return np.asarray((np.exp(logs.clip(*self.bounds)) * drawn).sum(axis=1))

    def best(self) -> tuple[dict[str, Any], float]:
        """Return the best configuration of a Sobol sequence through the space, and its true mean steps."""
        points = sobol(len(self.space.parameters), N_PLACES)
        configs = [values_at(self.space, row) for row in points]
        truth = self.truth(np.array([places_of(self.space, values) for values in configs]))
        return configs[int(truth.argmin())], float(truth.min())


def centred(logs: FloatArray, config_of: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """Return the mean of each configuration's trainings, and the difference of each training from it.

    Args:
        logs: Logarithms of each training, shape (trainings, parts).
        config_of: Configuration of each training, shape (trainings,).
    """
    means = np.array([logs[config_of == number].mean(axis=0) for number in range(config_of.max() + 1)])
    n_seeds = np.bincount(config_of)[config_of, np.newaxis]
    # Differences from a mean over few seeds are too small, because each seed has moved that mean.
    return means, (logs - means[config_of]) * np.sqrt(n_seeds / (n_seeds - 1))


def _boxes(tree: Any) -> tuple[FloatArray, FloatArray]:
    """Return the lower and the upper corner of each node of a tree of scikit-learn, each (nodes, dimensions)."""
    low = np.full((tree.node_count, tree.n_features), -np.inf)
    high = -low
    # A node comes before its children.
    for node in np.flatnonzero(tree.children_left >= 0):
        left, right, split = tree.children_left[node], tree.children_right[node], tree.feature[node]
        low[[left, right]], high[[left, right]] = low[node], high[node]
        high[left, split] = low[right, split] = tree.threshold[node]
    return low, high


@dataclass(frozen=True)
class SimulatedConfig:
    """A configuration of a surrogate.

    Args:
        surrogate: The surrogate.
        mean: Mean logarithm of its epochs, selection and test, shape (epochs + 2,).
        shares: Probability that the residuals of each training are drawn, shape (trainings,).
    """

    surrogate: Surrogate
    mean: FloatArray
    shares: FloatArray

    def train(self, rng: np.random.Generator) -> Training:
        """Return a training with a fresh seed."""
        (steps,) = self.draw(rng, 1)
        return Training(steps[:-2], float(steps[-2]), float(steps[-1]))

    def draw(self, rng: np.random.Generator, n_seeds: int) -> FloatArray:
        """Return epochs, selection and test of trainings with fresh seeds, shape (seeds, epochs + 2)."""
        places = rng.random(n_seeds) * self.shares.sum()
        drawn = np.searchsorted(self.shares.cumsum(), places, side="right")
        return np.asarray(np.exp((self.mean + self.surrogate.residuals[drawn]).clip(*self.surrogate.bounds)))

    @property
    def truth(self) -> float:
        """The mean steps on the test volumes over all trainings that could be drawn."""
        return self.truth_of(-1)

    def truth_of(self, part: int) -> float:
        """Return the same of any part, such as `SELECTION_PART`."""
        logs = self.mean[part] + self.surrogate.residuals[:, part]
        return float(np.exp(logs.clip(*self.surrogate.bounds)) @ self.shares)


def fit_of(curves: Curves) -> tuple[float, float]:
    """Return how well a surrogate predicts configurations that were left out, in ten folds.

    Returns:
        Spearman's rank correlation of the predicted with the measured mean logarithm of the test's mean steps, and the
        share of the variance that is explained.
    """
    places, known = curves.places(), curves.mean_over_seeds(np.log(curves.test["mean_steps"]))
    told = np.empty(len(known))
    for fold in range(N_FOLDS):
        is_out = np.arange(len(known)) % N_FOLDS == fold
        if is_out.any():
            told[is_out] = Surrogate.of(curves, without=fold).weights(places[is_out]) @ known
    return float(spearmanr(told, known).statistic), float(1.0 - ((told - known) ** 2).mean() / known.var())
