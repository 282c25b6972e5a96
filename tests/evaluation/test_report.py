"""The tables of an evaluation."""

from dataclasses import replace
from io import StringIO

import pytest
from rich.console import Console

from armscan.evaluation.report import EvaluationReport, report_tables
from armscan.training import Evaluation
from tests.training.test_train import evaluation_of


def printed(episodes):
    report = EvaluationReport({"test volumes": Evaluation(tuple(episodes))}, has_total=False, facts={})
    console = Console(width=200, record=True, file=StringIO())
    for part in report_tables(report, 200):
        console.print(part)
    return console.export_text()


@pytest.fixture
def doubting():
    (usual,) = evaluation_of(1).episodes
    return [replace(usual, seed=i, distance_mm=float(i), expected_mm=float(i), expected_deg=1.0) for i in range(4)]


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
