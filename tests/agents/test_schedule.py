"""Hyperparameters that change while a learner learns."""

import pytest
import torch

from armscan.agents import (
    MLP,
    PPO,
    SAC,
    Exhaustive,
    Learner,
    ResidualSAC,
    ScheduledLearner,
    Segment,
    scheduled_algorithms,
)
from armscan.agents.batch_agent import BatchAgent
from armscan.agents.plane_finder_learner import PlaneFinderLearner
from armscan.agents.residual_learner import ResidualLearner
from armscan.agents.schedule import read_schedule
from armscan.agents.scheduled_learner import OPTIONAL
from armscan.errors import InvalidValueError
from tests.agents.conftest import ENV_FACTORIES, setup_for
from tests.support.tensors import assert_same_tensors

# What changes after 40 environment steps, and after 60, by the name of the algorithm.
CHANGES = {
    "SAC": (
        {"lr": 0.02, "ent_coef_lr": 0.05, "batch_size": 24, "gamma": 0.5, "target_entropy_per_dim": -1.0},
        {"utd_ratio": 1.0, "tau": 0.1},
    ),
    "PPO": ({"lr": 0.02, "n_epochs": 3, "ent_coef": 0.1, "max_grad_norm": 0.1}, {"clip_range": 0.05, "batch_size": 5}),
    "Regression": ({"lr": 0.02, "batch_size": 24}, {"utd_ratio": 1.0, "own_planes_share": 0.0}),
}


@pytest.fixture
def make_scheduled(algorithm, phantom):
    """Make a learner with a schedule, or one without."""
    env_factory, network = ENV_FACTORIES["vector"]

    def made(is_scheduled=True):
        setup, first = setup_for(env_factory, phantom, total_env_steps=200), algorithm(network)
        segments = [Segment(*each) for each in zip((40, 60), CHANGES[type(first).__name__], strict=True)]
        later = [(start, each.agent(setup)) for start, each in scheduled_algorithms(first, segments)]
        return ScheduledLearner(first.agent(setup), later) if is_scheduled else first.agent(setup)

    return made


def learned(learner, until):
    if not learner.n_env_steps:
        learner.warm_up()
    while learner.n_env_steps < until:
        learner.learn(20)
    return learner.state()


def test_learner_with_a_schedule_is_a_learner_that_plays_side_by_side(make_scheduled):
    assert isinstance(make_scheduled(), Learner)
    assert isinstance(make_scheduled(), BatchAgent)


def test_learner_with_a_schedule_has_the_notes_of_its_learner(make_scheduled):
    scheduled, learner = make_scheduled(), make_scheduled(is_scheduled=False)
    for note in ("update_note", "validation_note", "warm_up_note"):
        assert getattr(scheduled, note, None) == getattr(learner, note, None)


def test_learner_with_a_schedule_has_every_optional_attribute_of_the_learners():
    with_attributes = (PlaneFinderLearner, ResidualLearner)
    of_learners = {name for learner in with_attributes for name in vars(learner) if not name.startswith("_")}
    assert of_learners - set(dir(Learner)) - set(dir(BatchAgent)) <= set(OPTIONAL)


def test_learner_with_a_schedule_says_which_changes_it_has_not_made(make_scheduled):
    scheduled = make_scheduled()
    assert scheduled.schedule_note is None
    learned(scheduled, 60)
    assert scheduled.schedule_note == "no epoch began at or after 60 environment steps: no such change was made"
    learned(scheduled, 80)
    assert scheduled.schedule_note is None


@pytest.mark.parametrize("resumed_at", [20, 40, 60, 80])
def test_learner_with_a_schedule_goes_on_from_any_epoch_bit_for_bit(make_scheduled, resumed_at):
    whole, first, second = (make_scheduled() for _ in range(3))
    learned(first, resumed_at)
    second.load_state(first.state())
    # A restarted process draws other numbers in between.
    torch.rand(7)
    assert_same_tensors(learned(whole, 120), learned(second, 120))


def test_learner_with_a_schedule_learns_otherwise_from_its_first_change_on(make_scheduled):
    scheduled, plain = make_scheduled(), make_scheduled(is_scheduled=False)
    assert_same_tensors(learned(scheduled, 40), learned(plain, 40))
    with pytest.raises(AssertionError, match="not equal"):
        assert_same_tensors(learned(scheduled, 80), learned(plain, 80))


@pytest.mark.parametrize("algorithm", ["sac"], indirect=True)
def test_learning_rates_are_those_of_the_schedule_and_not_of_the_checkpoint(make_scheduled):
    learner = make_scheduled()
    learned(learner, 60)
    algorithm = learner._learner._algorithm
    rates = [each._optim.param_groups[0]["lr"] for each in algorithm._optimizers]
    assert rates == [0.02] * 3
    assert algorithm.alpha._optim.param_groups[0]["lr"] == 0.05
    assert (algorithm.gamma, algorithm.tau) == (0.5, 0.005)
    learned(learner, 80)
    # What changed before stays changed.
    assert (learner._learner._algorithm.gamma, learner._learner._algorithm.tau) == (0.5, 0.1)


@pytest.mark.parametrize(
    ("described", "line"),
    [
        (3, "training.schedule is 3, but it must be null or a list such as [{from_env_steps: 4000, agent.lr: 0.001}]"),
        ([3], "training.schedule is [3], but it must be null or a list"),
        (
            [{}],
            "training.schedule[0].from_env_steps is None, but it must be a whole number of at least 1 and at most 99",
        ),
        (
            [{"from_env_steps": 0}],
            "training.schedule[0].from_env_steps is 0, but it must be a whole number of at least 1",
        ),
        (
            [{"from_env_steps": 100}],
            "training.schedule[0].from_env_steps is 100, but it must be a whole number of at least",
        ),
        (
            [{"from_env_steps": 9, "agent.lr": 1}] * 2,
            "training.schedule[1].from_env_steps is 9, but it must be a whole number of at least 10",
        ),
        ([{"from_env_steps": 9}], "training.schedule[0] changes nothing: give keys of agent, such as agent.lr, beside"),
        ([{"from_env_steps": 9, "lr": 1}], "there is no key 'lr' in training.schedule[0], but only from_env_steps and"),
    ],
)
def test_schedule_answers_mistakes_in_one_line(described, line):
    with pytest.raises(InvalidValueError) as raised:
        read_schedule(described, 100)
    assert str(raised.value).startswith(line)


@pytest.mark.parametrize(
    ("algorithm", "values", "line"),
    [
        (
            SAC(network=MLP()),
            {"buffer_size": 9},
            "training.schedule[0] changes agent.buffer_size, but during a training",
        ),
        (PPO(network=MLP()), {"network": None}, "training of PPO only this can change: agent.lr, agent.lr_end_factor"),
        (Exhaustive(), {"lr": 0.1}, "a training of Exhaustive only this can change: nothing"),
        (SAC(network=MLP()), {"gamma": 2.0}, "agent.gamma is 2.0, but it must be"),
    ],
)
def test_schedule_changes_only_what_can_change_to_what_is_allowed(algorithm, values, line):
    with pytest.raises(InvalidValueError) as raised:
        scheduled_algorithms(algorithm, [Segment(40, values)])
    assert line in str(raised.value)


def test_schedule_of_residual_sac_ends_with_its_pretraining():
    residual = ResidualSAC(sac=SAC(network=MLP()), pretraining_env_steps=40)
    assert scheduled_algorithms(residual, [Segment(39, {"lr": 1e-4})])[0][1].lr == 1e-4
    with pytest.raises(InvalidValueError, match=r"from_env_steps is 40, .* below agent.pretraining_env_steps = 40"):
        scheduled_algorithms(residual, [Segment(39, {"lr": 1e-4}), Segment(40, {"lr": 1e-5})])
