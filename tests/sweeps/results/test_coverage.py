"""The interval that a study prints holds a known truth, after its configuration was selected."""

import pytest

from benchmarks.sweeps.result_intervals import simulate


@pytest.mark.parametrize(
    ("n_seeds", "n_volumes", "effect"),
    [(2, 8, 0.0), (3, 8, 0.0), (3, 12, 1.0), (5, 4, 1.0), (5, 12, 0.0), (10, 8, 0.0)],
)
def test_interval_of_a_selected_configuration_holds_the_truth_in_92_to_98_percent_of_studies(
    n_seeds, n_volumes, effect
):
    found = simulate(1200, n_seeds, n_volumes, effect)
    assert found.n_studies > 800
    assert 0.92 <= found.paired <= 0.98


def test_interval_of_the_probability_of_improvement_holds_it_and_a_bootstrap_of_the_seeds_would_not():
    found = simulate(1200, 5, 12, 0.0)
    assert found.improvement >= 0.92
    assert found.bootstrap < 0.92
