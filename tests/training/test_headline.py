"""The result in a few sentences: its difference to random planes recomputed by the test, and what it claims."""

import numpy as np
import pytest
from scipy import stats

from armscan.stats.on_plane import ON_PLANE
from armscan.stats.proportions import difference_of_rates, wilson
from armscan.training import Evaluation, MetricEstimates, ResultTable
from armscan.training.headline import ABOVE_RANDOM, beside_random, headline
from tests.training.test_train import episode_of


def evaluation(rates, n=20):
    """Return episodes on volumes `v0`, `v1` and so on, of which these shares end on the plane."""
    return Evaluation(
        tuple(
            episode_of(volume=f"v{k}", distance_mm=1.0 if i < round(rate * n) else 9.0, distance_deg=0.0)
            for k, rate in enumerate(rates)
            for i in range(n)
        )
    )


def said_of(rates, random_rates):
    ours, random = evaluation(rates), evaluation(random_rates)
    figures = beside_random(MetricEstimates.of(ours), [ours], random)
    return headline({"agent": figures}, {"agent": MetricEstimates.of(random)})


def test_difference_is_that_of_a_paired_t_test_over_the_volumes():
    rates, random_rates = [0.9, 0.6, 0.8, 0.55], [0.5, 0.35, 0.6, 0.2]
    ours = evaluation(rates)
    above = beside_random(MetricEstimates.of(ours), [ours], evaluation(random_rates)).estimates[ABOVE_RANDOM]
    interval = stats.ttest_rel(rates, random_rates).confidence_interval()
    assert above == pytest.approx((np.subtract(rates, random_rates).mean(), *interval))


@pytest.mark.parametrize(
    ("rates", "random_rates", "comparison"),
    [
        ([0.9, 0.8, 0.85, 0.9], [0.5, 0.45, 0.4, 0.5], "Better than random: +40.0 points ("),
        ([0.1, 0.2, 0.1, 0.15], [0.5, 0.45, 0.4, 0.5], "Worse than random: -32.5 points ("),
        ([0.9, 0.1, 0.5, 0.55], [0.5, 0.45, 0.4, 0.5], "Not shown to be better than random: +5.0 points ("),
        ([0.9], [0.5], "Difference +40.0 points, one subject and one seed: this allows no conclusion about others."),
    ],
)
def test_comparison_follows_the_interval_of_the_difference(rates, random_rates, comparison):
    assert comparison in said_of(rates, random_rates)


def test_difference_that_is_the_same_on_all_volumes_has_an_interval_for_other_episodes():
    ours, random = evaluation([0.9, 0.9]), evaluation([0.8, 0.8])
    above = beside_random(MetricEstimates.of(ours), [ours], random).estimates[ABOVE_RANDOM]
    assert above == pytest.approx(difference_of_rates(wilson(36, 40), wilson(32, 40)))
    assert "Not shown to be better than random: +10.0 points (" in said_of([0.9, 0.9], [0.8, 0.8])


def test_difference_on_one_subject_contains_the_noise_of_random_planes():
    """Agents that are as good as random planes are rarely said to be better or worse."""
    rng, n_episodes, n_false = np.random.default_rng(0), 100, 0
    for _ in range(100):
        *ours, random = (evaluation([rng.binomial(n_episodes, 0.5) / n_episodes], n_episodes) for _ in range(6))
        above = beside_random(MetricEstimates.of(ours[0]), ours, random).estimates[ABOVE_RANDOM]
        assert above.value == pytest.approx(np.mean([each.on_plane_rate for each in ours]) - random.on_plane_rate)
        n_false += not above.low <= 0.0 <= above.high
    assert n_false <= 10


def test_interval_of_a_difference_of_rates_ends_at_100_points():
    assert "(-100.0 to +100.0)" in said_of([0.0, 1.0, 0.5], [1.0, 0.0, 0.5])


def test_without_random_planes_on_the_same_volumes_nothing_is_said_of_them():
    ours = evaluation([0.9, 0.8])
    figures = MetricEstimates.of(ours)
    assert beside_random(figures, [ours], evaluation([0.5])) is figures
    assert beside_random(figures, [ours], None) is figures
    # One training of two suffices.
    assert beside_random(figures, [evaluation([0.5]), ours], evaluation([0.5])) is figures
    said = headline({"agent": figures}, {})
    assert said.startswith("On plane, 5 mm 10°: agent 85.0% (")
    assert "random" not in said
    assert said.endswith("Median distance 1.0 mm, 0.0°.")


def test_best_of_several_results_is_named():
    figures = {
        name: MetricEstimates.of(evaluation([rate, rate])) for name, rate in (("0 (a=1)", 0.3), ("1 (a=2)", 0.7))
    }
    assert headline(figures, {}).startswith("On plane, 5 mm 10°: best of 2, chosen on these volumes: 1 (a=2), 70.0% (")


def test_results_within_different_limits_have_no_headline():
    figures = [
        MetricEstimates.of(Evaluation(evaluation([0.5, 0.6]).episodes, limits)) for limits in (ON_PLANE, ON_PLANE[::-1])
    ]
    assert headline({"a": figures[0]}, {}) != "" != headline({"b": figures[1]}, {})
    assert headline(dict(zip("ab", figures, strict=True)), {}) == ""


def test_difference_is_that_of_the_rates_though_volumes_have_unequal_numbers_of_episodes():
    ours, random = (
        Evaluation((*evaluation(rates, n=2).episodes, *evaluation(rates[:1], n=4).episodes))
        for rates in ([1.0, 0.5, 1.0], [0.5, 1.0, 0.5])
    )
    above = beside_random(MetricEstimates.of(ours), [ours], random).estimates[ABOVE_RANDOM]
    assert above.value == pytest.approx(ours.on_plane_rate - random.on_plane_rate)


def test_results_without_the_rate_have_no_headline():
    assert headline({"agent": MetricEstimates.of_metrics({"success_rate": 0.5})}, {}) == ""
    assert headline({}, {}) == ""


def test_pages_have_the_headline_above_the_table():
    table = ResultTable({"agent": MetricEstimates.of(evaluation([0.9, 0.8]))}, headline="On <plane>.")
    assert table.html().startswith("<p><strong>On &lt;plane&gt;.</strong></p>")
    assert table.markdown().startswith("**On <plane>.**\n\n")
