"""More episodes of an evaluation: less noise between seeds, and fewer trainings of a race."""

import numpy as np
import pandas as pd
import pytest

from armscan.errors import InvalidValueError
from benchmarks.sweeps.bench import episodes
from benchmarks.sweeps.bench.episodes import (
    COLUMNS,
    N_BLOCKS,
    Evaluations,
    collect_evaluations,
    races,
    share_of_noise,
)
from benchmarks.sweeps.bench.table import Curves, write_sorted
from tests.benchmarks.test_bench_table import SMALL


@pytest.fixture
def table(curves, monkeypatch):
    """Make these curves the table of every sweep."""
    monkeypatch.setattr(Curves, "read", lambda sweep: curves)


@pytest.mark.usefixtures("table")
def test_more_episodes_leave_less_noise_and_save_trainings(curves, tmp_path):
    file, rng, n_seeds = tmp_path / "a.csv.gz", np.random.default_rng(0), 8
    worth = np.repeat(curves.mean_over_seeds(np.log(curves.test["mean_steps"])), n_seeds)
    of_training, of_episodes = rng.normal(0.0, 0.1, len(worth)), rng.normal(0.0, 0.2, (N_BLOCKS, len(worth)))
    rows = {"config": np.arange(len(worth)) // n_seeds, "seed": np.arange(len(worth)) % n_seeds}
    rows |= {name: np.exp(worth + of_training + each) for name, each in zip(COLUMNS, of_episodes, strict=True)}
    write_sorted(file, pd.DataFrame(rows), ["config", "seed"])
    evaluated = Evaluations.read("sac_y", file)
    share = share_of_noise(evaluated.noise())
    # Of a block, and of five.
    assert share.value == pytest.approx((0.1**2 + 0.2**2 / 5) / (0.1**2 + 0.2**2), abs=0.05)
    assert share.low < share.value < share.high
    few, more, many = races(evaluated, n_studies=4, n_trainings=20, top_k=3).values()
    assert more.share.value < 0.7 * few.share.value
    assert more.n_trainings == many.n_trainings


@pytest.mark.usefixtures("table")
def test_evaluations_are_added_to_by_the_same_command(tmp_path, curves, monkeypatch):
    file = tmp_path / "a.csv.gz"
    monkeypatch.setattr(Curves, "read", lambda sweep: curves.of(np.array([0])))
    monkeypatch.setattr(episodes, "N_EPISODES", 2)
    for n_seeds in (1, 2):
        collect_evaluations("sac_y", n_seeds, overrides=SMALL, file=file)
        rows = pd.read_csv(file)
        assert list(rows.seed) == [*range(n_seeds)]
    assert (rows[[*COLUMNS]] >= 1).all(axis=None)
    with pytest.raises(InvalidValueError, match="collect-episodes sac_y"):
        Evaluations.read("sac_y", tmp_path / "b.csv.gz")
