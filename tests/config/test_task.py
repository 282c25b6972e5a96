"""Which keys make runs those of another task, or of other test volumes."""

import pytest

from armscan.config.task import have_same_task

PARAMS = {"projection": "y", "env.max_steps": "50", "env.stack": "1", "data.path": "a", "agent.lr": "0.1"}


@pytest.mark.parametrize(
    "key",
    [
        "projection",
        "reward._target_",
        "env.max_steps",
        "data.path",
        "data.fold",
        "data.version",
        "env.transform.rx_deg",
    ],
)
def test_runs_that_differ_in_the_task_or_the_test_volumes_do_not_have_the_same(key):
    assert not have_same_task([PARAMS, PARAMS | {key: "other"}])


@pytest.mark.parametrize(
    "key", ["agent.lr", "env.stack", "env.observation._target_", "seed", "data.n_training", "env.transform.scale"]
)
def test_runs_that_differ_in_agents_and_what_these_see_have_the_same_task(key):
    assert have_same_task([PARAMS, PARAMS | {key: "other"}])
    # A run that was killed at its start has none.
    assert have_same_task([PARAMS, {}])
