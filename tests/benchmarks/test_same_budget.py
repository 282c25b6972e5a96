"""Budgets of the two searches, the choice of an unfinished race, and the pairing of the results."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import optuna
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from optuna.distributions import CategoricalDistribution, FloatDistribution

from armscan.sweeps.study.settings import FinalEvalSettings
from benchmarks.sweeps import same_budget, searches
from benchmarks.sweeps.same_budget import Results, scores_of, table
from benchmarks.sweeps.searches import Meter, SearchResult, chosen_of, swept

ROOT = Path(__file__).parents[2]


def attempt(number):
    return SimpleNamespace(trial=SimpleNamespace(number=number))


@pytest.fixture
def clock(monkeypatch):
    clock = SimpleNamespace(now_s=0.0)
    monkeypatch.setattr(searches.time, "process_time", lambda: clock.now_s)
    return clock


def test_pruned_trials_use_the_budget_too(clock):
    def run(attempt):
        clock.now_s += 3.0
        if attempt.trial.number == 1:
            raise optuna.TrialPruned
        return {}

    meter = Meter(7.0)
    meter.timed(run)(attempt(0))
    with pytest.raises(optuna.TrialPruned):
        meter.timed(run)(attempt(1))
    assert meter.used_s == pytest.approx(6.0)
    assert not meter.is_used()
    assert meter.is_used(kept_s=1.0)


def test_time_between_trials_is_not_charged(clock):
    meter = Meter(1.0)
    meter.timed(lambda _: {})(attempt(0))
    clock.now_s += 100.0
    assert not meter.is_used()


def settings(min_seeds, mean_seeds):
    return FinalEvalSettings(top_k=2, min_seeds=min_seeds, mean_seeds=mean_seeds, test_seeds=1, episodes=3)


def test_a_race_that_is_cut_off_is_decided_by_the_seeds_that_are_complete():
    # After two seeds 5 leads; the third seed of all, with which it is bad, was not complete.
    scores = {-1: {0: -3.0, 1: -3.1, 2: -3.0}, 5: {0: -1.0, 1: -1.1, 2: -9.0}, 7: {0: -4.0, 1: -4.2}}
    assert chosen_of(scores, range(8), settings(3, 6)) == 5
    scores[7][2] = -4.1
    assert chosen_of(scores, range(3), settings(3, 6)) == -1


def test_a_race_without_a_complete_round_chooses_nothing():
    assert chosen_of({-1: {0: -3.0}, 5: {}}, range(8), settings(3, 6)) is None


def test_a_training_of_a_race_that_failed_drops_its_configuration():
    assert chosen_of({-1: {0: -3.0}, 5: {0: math.nan}}, range(1), settings(1, 1)) == -1


@pytest.mark.parametrize(
    "distribution",
    [
        FloatDistribution(-4.0, -1.0),
        FloatDistribution(1e-4, 1e-2, log=True),
        CategoricalDistribution([0.0, 0.5, 0.99]),
    ],
)
def test_hydra_reads_the_range_that_armscan_searches(distribution):
    value = OverridesParser.create().parse_override(f"key={swept(distribution)}").value()
    if isinstance(distribution, CategoricalDistribution):
        assert tuple(value.list) == distribution.choices
    else:
        assert (value.start, value.end) == (distribution.low, distribution.high)
        assert ("log" in value.tags) == distribution.log


@pytest.fixture
def trained(monkeypatch):
    """Replace the searches by two that find `a` and `b`, which score 1 and 2; the default configuration scores 4."""
    trained = []

    def search(name):
        return lambda words, budget_s, folder: SearchResult({"key": name}, budget_s, 20)

    def train_and_evaluate(words, values, seed):
        trained.append((values.get("key"), seed))
        value = {"a": 1.0, "b": 2.0}.get(values.get("key"), 4.0)
        volumes = {f"v{number}": value + number + seed % 10 for number in (1, 0)}
        evaluations = {name: SimpleNamespace(metrics=lambda v=v: {"mean_steps": v}) for name, v in volumes.items()}
        return None, {"test": SimpleNamespace(by_volume=lambda: evaluations)}

    monkeypatch.setattr(same_budget, "SEARCHES", {"armscan": search("a"), "hydra": search("b")})
    monkeypatch.setattr(same_budget, "train_and_evaluate", train_and_evaluate)
    return trained


def test_both_are_judged_with_the_same_seeds_and_volumes(trained, tmp_path):
    same_budget.same_budget(tmp_path, replicates=2, seeds=3)
    rows = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    _, scores = scores_of(rows, "sac_y")
    assert scores["armscan"] == pytest.approx(np.array([[2.0, 3.0], [2.0, 3.0]]))
    assert scores["hydra"] - scores["armscan"] == pytest.approx(np.ones((2, 2)))
    assert scores["default"] - scores["armscan"] == pytest.approx(np.full((2, 2), 3.0))
    assert "| armscan minus Hydra | -1.000 (-1.000 to -1.000) | -1.000 (-1.000 to -1.000) |" in table(rows)
    assert {seed for name, seed in trained if name == "a"} == {seed for name, seed in trained if name == "b"}


def test_replicates_have_seeds_of_their_own(trained, tmp_path):
    same_budget.same_budget(tmp_path, replicates=2, seeds=3)
    of_default = [seed for name, seed in trained if name is None]
    assert sorted(of_default) == sorted(2 * [5000, 5001, 5002, 5010, 5011, 5012])


@pytest.mark.parametrize("n_seeds", [8, 32])
def test_more_seeds_of_a_comparison_begin_with_the_same_ones(trained, tmp_path, n_seeds):
    same_budget.same_budget(tmp_path, tasks=["sac_y"], replicates=3, seeds=n_seeds)
    seeds = {}
    for row in Results(tmp_path / "results.jsonl").rows:
        if "seed" in row:
            seeds.setdefault(row["replicate"], set()).add(row["seed"])
    assert all(set(range(5000 + 10 * replicate, 5008 + 10 * replicate)) <= own for replicate, own in seeds.items())
    assert len(set.union(*seeds.values())) == 3 * n_seeds, "no two replicates share a seed"


def test_processes_share_a_folder(trained, tmp_path):
    for first in (2, 0):
        same_budget.same_budget(tmp_path, tasks=["sac_y"], first=first, replicates=2, seeds=1)
    rows = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    replicates, scores = scores_of(rows, "sac_y")
    assert replicates == [0, 1, 2, 3]
    assert [len(each) for each in scores.values()] == [4, 4, 4]
    assert sorted(seed for name, seed in trained if name == "a") == [5000, 5010, 5020, 5030]


def test_a_benchmark_that_was_killed_goes_on(trained, tmp_path):
    same_budget.same_budget(tmp_path, replicates=2, seeds=2)
    file = tmp_path / "results.jsonl"
    whole = file.read_text().splitlines()
    file.write_text("\n".join(whole[:-3]) + "\n")
    trained.clear()
    same_budget.same_budget(tmp_path, replicates=2, seeds=2)
    assert file.read_text().splitlines() == whole
    assert len(trained) == 3


def test_a_replicate_that_is_not_judged_yet_is_left_out(trained, tmp_path):
    same_budget.same_budget(tmp_path, replicates=2, seeds=1)
    rows = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    replicates, scores = scores_of(rows[:-1], "sac_zy")
    assert replicates == [0]
    assert [len(each) for each in scores.values()] == [1, 1, 1]


def test_page_has_the_table_of_the_results_that_are_kept():
    rows = Results(ROOT / "benchmarks/sweeps/hydra_optuna/results.jsonl").rows
    assert table(rows) in (ROOT / "docs/benchmarks-studies.md").read_text()
