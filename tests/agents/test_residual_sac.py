"""The plane finder whose planes SAC corrects."""

from copy import deepcopy

import numpy as np
import pytest
import torch
from hydra.errors import InstantiationException

from armscan.agents import MLP, SAC, Compute, Learner, ResidualSAC
from armscan.agents.policy import batch_of
from armscan.agents.torch_export import export_program
from armscan.config.compose import compose
from armscan.config.error_messages import one_line_message
from armscan.envs import EnvFactory
from armscan.errors import DivergedError, InvalidValueError
from armscan.experiment.agent import make_algorithm
from armscan.training import evaluate
from armscan.training.episodes import play
from tests.agents.conftest import SMALL_SAC, setup_for
from tests.agents.test_plane_finder import NAMES, RULES, SMALL, assert_policy_answers, played
from tests.support.tensors import assert_same_tensors

N_TAUGHT = 24


def made(phantom, total_env_steps=200, rules=None, precision="float32", **changes):
    env_factory = EnvFactory(**RULES | (rules or {}))
    names = (*NAMES, "stop") if (rules or {}).get("ends") == "on_stop" else NAMES
    compute = Compute("cpu", precision)
    setup = setup_for(env_factory, phantom, action_names=names, total_env_steps=total_env_steps, compute=compute)
    sac = SAC(network=MLP((8,)), **SMALL_SAC)
    learner = ResidualSAC(**SMALL | {"sac": sac, "pretraining_env_steps": N_TAUGHT} | changes).agent(setup)
    return learner, env_factory.make_env([phantom])


@pytest.fixture
def corrected(phantom):
    """Make a learner that SAC has changed, and its environment."""
    learner, env = made(phantom)
    for _ in range(3):
        learner.learn(40)
    return learner, env


def finder_weights(learner):
    return {name: w.clone() for name, w in learner.weights().items() if name.startswith("finder.")}


def test_teaching_ends_with_its_steps_and_the_rest_is_for_sac(phantom):
    learner, _ = made(phantom)
    assert isinstance(learner, Learner)
    learner.warm_up()
    assert "update/loss" in learner.learn(100)
    assert learner.n_env_steps == N_TAUGHT
    assert "update/critic_loss" in learner.learn(40)
    # Its random corrections are among them.
    assert learner.n_env_steps == N_TAUGHT + 40
    assert "from the pretraining" in learner.weights_note(N_TAUGHT)
    assert learner.weights_note(N_TAUGHT + 40) is None


def test_pretraining_takes_its_own_steps_also_if_sac_collects_more_at_once(phantom):
    learner, _ = made(phantom, sac=SAC(network=MLP((8,)), **SMALL_SAC | {"env_steps_per_collection": 20}))
    learner.learn(N_TAUGHT)
    assert learner.n_env_steps == N_TAUGHT


@pytest.mark.parametrize("n_averaged", [1, 2])
def test_corrections_begin_after_the_teaching_and_leave_the_plane_finder_as_it_is(phantom, n_averaged):
    learner, env = made(phantom, n_averaged=n_averaged)
    learner.learn(N_TAUGHT)
    observation, _ = env.reset(seed=0)
    looks = learner._tensors(batch_of([observation]))
    found = learner._network.finder(looks)[0][0]
    assert torch.equal(learner._network(looks)[0][0], found)
    taught = finder_weights(learner)
    learner.learn(40)
    assert all(torch.equal(w, taught[name]) for name, w in finder_weights(learner).items())
    assert not torch.equal(learner._network(looks)[0][0], found)


def test_corrections_stay_within_their_limits(corrected):
    learner, env = corrected
    with torch.no_grad():
        learner._network.actor.mu.model[0].bias.fill_(100.0)
    looks = learner._tensors(batch_of([env.reset(seed=0)[0]]))
    geometry, (actions, _) = learner._module.geometry, learner._network(looks)[0]
    estimate = learner._module.estimate(looks)
    wanted = geometry.from_frame(estimate.plane, estimate.place + learner._network.limits, torch.tensor([9.0]))
    torch.testing.assert_close(geometry.planes(actions), wanted, atol=1e-3, rtol=0)


@pytest.mark.parametrize("n_before", [1, 2])
def test_learner_goes_on_from_its_state_to_the_bit(phantom, n_before):
    """Also from the end of the pretraining."""
    one, other = made(phantom)[0], made(phantom)[0]
    for _ in range(n_before):
        one.learn(40)
    other.load_state(deepcopy(one.state()))
    for learner in (one, other):
        learner.learn(40)
    assert one.n_env_steps == other.n_env_steps
    assert_same_tensors(one.weights(), other.weights())


def test_policy_answers_as_the_learner_does_also_exported(corrected):
    assert_policy_answers(*corrected)


def test_policy_of_mixed_precision_is_a_copy_in_32_bits_also_exported(phantom):
    learner, env = made(phantom, precision="bfloat16")
    for _ in range(2):
        learner.learn(40)
    policy, batch = learner.policy(), batch_of([env.reset(seed=seed)[0] for seed in range(2)])
    actions = policy(batch)
    np.testing.assert_allclose(export_program(policy, batch).module()(batch), actions, atol=1e-6)
    learner.load_weights({name: torch.zeros_like(weights) for name, weights in learner.weights().items()})
    assert torch.equal(policy(batch), actions)


def test_errors_are_expected_of_planes_that_are_not_corrected(phantom):
    learner, env = made(phantom)

    def expected():
        results = (play(learner, env, phantom.name, seed=3), *evaluate(learner, env, n_episodes=2, seed=3).episodes)
        return [error for each in results for error in (each.expected_mm, each.expected_deg)]

    learner.learn(N_TAUGHT)
    assert min(expected()) > 0.0
    learner.learn(40)
    assert set(expected()) == {None}


def test_learner_stops_where_its_plane_finder_does(phantom):
    learner, env = made(phantom, rules={"ends": "on_stop", "max_steps": 10})
    for _ in range(2):
        learner.learn(40)
    actions, terminated = played(learner, env)
    assert terminated
    assert (actions[1:, 4] > 0).tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"pretraining_env_steps": 200},
            "agent.pretraining_env_steps is 200, but it must be below training.env_steps = 200",
        ),
        ({"pretraining_env_steps": 0}, "agent.pretraining_env_steps is 0"),
        (
            {"pretraining_env_steps": 3},
            "takes 12 environment steps .3 looks in each environment., but agent.pretraining_env_steps is 3$",
        ),
        ({"correction_mm": 0.0}, "agent.correction_mm is 0"),
        ({"sac": None}, "agent.sac is None"),
        (
            {"sac": SAC(network=MLP((8,)), **SMALL_SAC, deterministic_eval=False)},
            "agent.sac.deterministic_eval is False, but it must be true",
        ),
    ],
)
def test_impossible_parameters_are_refused(phantom, changes, message):
    with pytest.raises(InvalidValueError, match=message):
        made(phantom, **changes)


def test_divergence_of_sac_names_its_keys(phantom):
    learner, _ = made(phantom)
    learner.learn(24)
    learner.learn(48)
    for weight in learner._sac._algorithm.policy.actor.parameters():
        weight.data.fill_(float("nan"))
    with pytest.raises(DivergedError, match=r"a smaller agent\.sac\.lr or agent\.sac\.ent_coef_lr may help"):
        learner.learn(48)


def test_what_sac_refuses_is_named_by_its_keys(phantom):
    message = r"agent.sac.learning_starts is 900, .* below training.env_steps - agent.pretraining_env_steps = 176"
    with pytest.raises(InvalidValueError, match=message):
        made(phantom, sac=SAC(network=MLP((8,)), **SMALL_SAC | {"learning_starts": 900}))
    with pytest.raises(InstantiationException) as refused:
        make_algorithm(compose(["experiment=few_wrists_sac", "agent.sac.lr=-1"]))
    assert one_line_message(refused.value).startswith("agent.sac.lr is -1, but")
