"""The tables of an evaluation."""

from dataclasses import replace

import pytest

from armscan.evaluation.report import EvaluationReport, report_tables
from armscan.training import Evaluation
from tests.training.test_result_table import text_of
from tests.training.test_train import episode_of, evaluation_of


def printed(episodes):
    report = EvaluationReport({"test volumes": Evaluation(tuple(episodes))}, has_total=False, facts={})
    return text_of(report_tables(report, 200), 200)


@pytest.fixture
def doubting():
    return [episode_of(seed=i, distance_mm=float(i), expected_mm=float(i), expected_deg=1.0) for i in range(4)]


def test_tables_show_the_errors_of_what_an_agent_is_surest_and_least_sure_of(doubting):
    text = printed(doubting)
    (surest,) = [line for line in text.splitlines() if "distance mm of the surest quarter, median" in line]
    (least,) = [line for line in text.splitlines() if "distance mm of the least sure quarter, median" in line]
    assert surest.split("median")[1].split()[0] == "0.00"
    assert least.split("median")[1].split()[0] == "3.00"
    assert "expected" in text


def test_tables_of_agents_without_doubt_say_nothing_of_it(doubting):
    text = printed(replace(each, expected_mm=None, expected_deg=None) for each in doubting)
    assert "quarter" not in text
    assert "expected" not in text


def test_metrics_of_volumes_with_similar_names_stay_apart():
    episodes = [episode_of(n_steps, volume=name) for n_steps, name in enumerate(("a(1)", "a[1]"), 1)]
    report = EvaluationReport({"volumes": Evaluation(tuple(episodes))}, has_total=False, facts={})
    of_volumes = [metrics for group, metrics in report.metrics().items() if group.startswith("volume/")]
    assert [metrics["mean_steps"] for metrics in of_volumes] == [1.0, 2.0]


def test_metrics_have_the_intervals_that_the_table_shows():
    report = EvaluationReport({"volumes": evaluation_of(*[2] * 8)}, has_total=False, facts={})
    shown = report.by_split["volumes"].estimate("success_rate")
    assert shown.low < shown.value == 1.0
    assert report.metrics()["volumes"]["success_rate_low"] == shown.low
    assert report.to_dict()["splits"]["volumes"]["figures"]["success_rate"] == shown._asdict()


def test_times_are_those_of_the_agent_alone():
    played = {"test volumes": evaluation_of(2, 4)}
    contents = EvaluationReport(played, has_total=False, facts={}, baselines={"random": played}).to_dict()
    of_agent, of_random = (
        each["splits"]["test volumes"]["figures"] for each in (contents, contents["baselines"]["random"])
    )
    assert "mean_seconds_per_plane" in of_agent
    assert "mean_seconds_per_plane" not in of_random
