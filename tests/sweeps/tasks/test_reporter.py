"""Reports of a training to its study."""

from pathlib import Path
from types import SimpleNamespace

from armscan.sweeps.tasks.reporter import Reporter
from armscan.training import Budget, EpochReport
from tests.training.test_train import evaluation_of

BUDGET = Budget(env_steps=400, eval_every_env_steps=50, validation_episodes=1)


def epoch(number):
    """Return the report of an epoch of 52 environment steps."""
    evaluation = evaluation_of(9)
    return EpochReport(
        epoch=number, n_env_steps=52 * number, wall_s=1.0, metrics={}, evaluation=evaluation, is_best=number == 1
    )


def test_epochs_that_a_trial_has_inherited_are_not_reported_one_by_one():
    """The parent has trained to 200 steps, in four epochs."""
    reported = []
    attempt = SimpleNamespace(
        interval=(200, 400),
        parent_folder=Path("0003"),
        objectives=("mean_steps",),
        report=lambda metrics, *, n_env_steps, n_inherited_env_steps, **_: reported.append(
            (n_env_steps, n_inherited_env_steps)
        ),
    )
    reporter = Reporter(attempt, seed=0, budget=BUDGET)
    # It was interrupted after its first epoch.
    reporter.on_start(BUDGET.env_steps, [epoch(number) for number in range(1, 6)])
    reporter.on_epoch(epoch(6))
    assert reported == [(260, 208), (312, 208)]
