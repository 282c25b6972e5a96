import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from benchmarks.sweeps.bench.collect import collect
from benchmarks.sweeps.bench.design import Design, place_of, value_at
from benchmarks.sweeps.bench.table import METRICS, Curves, read_rows, write_rows

DISTRIBUTIONS = [
    FloatDistribution(-1.0, 2.0),
    FloatDistribution(1e-4, 1e-2, log=True),
    IntDistribution(2, 12),
    IntDistribution(4, 150, log=True),
    CategoricalDistribution([64, 128, 256]),
]


@given(distribution=st.sampled_from(DISTRIBUTIONS), place=st.floats(0.0, 1.0, exclude_max=True))
def test_each_place_has_a_value_of_the_distribution(distribution, place):
    value = value_at(distribution, place)
    assert distribution._contains(distribution.to_internal_repr(value))
    assert 0.0 <= place_of(distribution, value) <= 1.0


def test_whole_numbers_and_choices_are_equally_likely():
    for distribution, n_values in ((IntDistribution(2, 12), 11), (CategoricalDistribution([64, 128, 256]), 3)):
        drawn = [value_at(distribution, place) for place in np.arange(0.005, 1.0, 0.01 / 3)]
        assert pd.Series(drawn).value_counts(normalize=True).between(0.9 / n_values, 1.1 / n_values).all()


@pytest.mark.parametrize("sweep", ["sac_y", "sac_zy", "ppo_zy"])
def test_a_larger_design_begins_with_the_smaller_one(sweep):
    small, large = Design.of(sweep, 5), Design.of(sweep, 40)
    assert large.configs[:5] == small.configs
    assert len(large.configs) == 40
    assert len({str(values) for values in large.configs}) == 40


def test_the_first_configuration_is_the_default_one():
    assert Design.of("sac_y", 1).configs == (
        {"agent.lr": 1e-3, "agent.gamma": 0.9, "agent.utd_ratio": 0.25, "agent.batch_size": 256},
    )


def rows_of(n_configs, n_seeds, n_epochs, left_out=()):
    design = Design.of("sac_y", n_configs)
    rows = []
    for number, values in enumerate(design.configs):
        for seed in range(n_seeds):
            of_training = {"fixed_sha256": design.fixed_sha256, "commit": "0123abc", "config": number, "seed": seed}
            rows_at = [("validation", 1000 * (epoch + 1), float(abs(epoch - 2))) for epoch in range(n_epochs)]
            for volumes, env_steps, more in (*rows_at, ("test", 3000, 0.5), ("selection", 3000, 0.25)):
                metrics = dict.fromkeys(METRICS, 0.5) | {"mean_steps": 1.0 + number + seed / 10 + more}
                at = {"volumes": volumes, "env_steps": env_steps, "processor_s": 1.0}
                if (number, seed) not in left_out:
                    rows.append({**of_training, **at, **metrics, **values})
    return pd.DataFrame(rows)


def test_a_table_is_read_as_it_was_written(tmp_path):
    file = tmp_path / "sac_y.csv.gz"
    rows = rows_of(4, 3, 5)
    write_rows(file, rows.sample(frac=1.0, random_state=0))
    pd.testing.assert_frame_equal(read_rows(file), rows, check_dtype=False)
    curves = Curves.read("sac_y", file)
    assert curves.validation["mean_steps"].shape == (12, 5)
    assert curves.config_of.tolist() == [0] * 3 + [1] * 3 + [2] * 3 + [3] * 3
    assert curves.env_steps.tolist() == [1000, 2000, 3000, 4000, 5000]
    assert curves.selection["mean_steps"][7] == pytest.approx(3.35)
    assert curves.test["mean_steps"][7] == pytest.approx(3.6)
    assert curves.validation["mean_steps"][7].tolist() == pytest.approx([5.1, 4.1, 3.1, 4.1, 5.1])


def test_configurations_with_few_seeds_are_left_out(tmp_path):
    file = tmp_path / "sac_y.csv.gz"
    write_rows(file, rows_of(4, 4, 5, left_out=[(1, 2), (1, 3), (2, 0)]))
    curves = Curves.read("sac_y", file)
    assert curves.configs == tuple(Design.of("sac_y", 4).configs[number] for number in (0, 2, 3))
    assert curves.config_of.tolist() == [0] * 4 + [1] * 3 + [2] * 4


def test_a_table_of_another_space_is_refused(tmp_path):
    file = tmp_path / "sac_y.csv.gz"
    rows = rows_of(2, 2, 3)
    write_rows(file, rows.assign(**{"agent.lr": 0.5}))
    with pytest.raises(ValueError, match=r"another agent\.lr in configuration 0"):
        Curves.read("sac_y", file)


def test_a_table_that_is_not_there_names_the_command(tmp_path):
    with pytest.raises(ValueError, match="collect sac_y"):
        Curves.read("sac_y", tmp_path / "sac_y.csv.gz")


SMALL = (
    *("training.env_steps=512", "training.eval_every_env_steps=256", "training.validation_episodes=2"),
    *("agent.learning_starts=32", "evaluation.episodes=2"),
    *("data.n_training=2", "data.n_validation=1", "data.n_test=1"),
)


def test_a_table_is_added_to_by_the_same_command(tmp_path):
    file = tmp_path / "sac_y.csv.gz"
    collect("sac_y", 1, 1, overrides=SMALL, file=file)
    first = read_rows(file)
    # Epochs end after whole collections of the agent.
    assert list(zip(first.volumes, first.env_steps, strict=True))[:2] == [("validation", 288), ("validation", 512)]
    collect("sac_y", 2, 1, overrides=SMALL, file=file)
    rows = read_rows(file)
    assert set(rows.config) == {0, 1}
    pd.testing.assert_frame_equal(rows[rows.config == 0], first, check_dtype=False)
    with pytest.raises(ValueError, match="--allow-changes"):
        collect("sac_y", 3, 1, overrides=[*SMALL, "evaluation.episodes=3"], file=file)
