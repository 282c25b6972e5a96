"""The result of a run in its table."""

from armscan.experiment.results import RunResult
from armscan.training import TEST, TRAINING, Evaluation
from tests.training.test_result_table import made_episodes


def test_agent_that_is_a_baseline_has_one_row():
    test, training, baseline = (Evaluation(made_episodes(seed)) for seed in range(3))
    played = {TRAINING: training, TEST: test}
    alone = RunResult(played, {"random": baseline}, own_baseline="random")
    assert list(alone.table().results) == ["agent, test", "agent, training"]
    beside = RunResult(played, {"random": baseline})
    assert list(beside.table().results) == ["agent, test", "random, test", "agent, training"]
