import numpy as np
import pytest

from benchmarks.sweeps.bench.design import Design, places_of
from benchmarks.sweeps.bench.surrogate import Surrogate
from benchmarks.sweeps.bench.table import METRICS, Curves

N_SEEDS, N_EPOCHS = 4, 10


def true_log(place):
    """Return the logarithm of the true mean steps at a place: the learning rate matters most, the batch size not."""
    return 0.5 + 6.0 * (place[0] - 0.6) ** 2 + 0.3 * place[1] + 1.5 * (place[2] - 0.7) ** 2


def synthetic_curves(n_configs):
    """Return the curves of a table whose truth is known."""
    design, rng = Design.of("sac_y", n_configs), np.random.default_rng(0)
    config_of = np.repeat(np.arange(n_configs), N_SEEDS)
    worth = np.array([true_log(places_of(design.space, values)) for values in design.configs])[config_of]
    # Noise of a seed in all of its evaluations, and of each evaluation.
    logs = worth[:, None] + 3.0 * np.exp(-np.arange(N_EPOCHS + 2) / 2.0)
    logs = logs + rng.normal(0.0, 0.1, (len(worth), 1)) + rng.normal(0.0, 0.025, logs.shape)
    steps = np.exp(logs.clip(0.0, np.log(50.0)))
    return Curves(
        "sac_y",
        design.space,
        design.configs,
        config_of,
        1200.0 * np.arange(1, N_EPOCHS + 1),
        dict.fromkeys(METRICS, steps[:, :-2]),
        dict.fromkeys(METRICS, steps[:, -2]),
        dict.fromkeys(METRICS, steps[:, -1]),
        np.ones(len(worth)),
    )


@pytest.fixture(scope="session")
def curves():
    return synthetic_curves(60)


@pytest.fixture(scope="session")
def surrogate(curves):
    return Surrogate.of(curves)
