"""A learner's policy alone: its answers, and its ONNX file."""

import numpy as np
import onnxruntime
import pytest
import torch
from torch import nn

from armscan.agents import Compute
from armscan.agents.policy import Policy, batch_of
from armscan.agents.torch_export import NEXT_ACTION, OBSERVATION, export_program, save_onnx
from armscan.envs.history import FLAT, parts_of
from armscan.errors import ExportError
from tests.agents.conftest import ENV_FACTORIES, setup_for

N_OBSERVED = 7


def observed(env, n=N_OBSERVED):
    """Observations of random planes."""
    env.action_space.seed(0)
    observations = [env.reset(seed=0)[0]]
    while len(observations) < n:
        action = env.action_space.sample()
        # A component `stop` above 0 would end the episode.
        action[4:] = -1.0
        observations.append(env.step(action)[0])
    return observations


def taught(learner):
    learner.warm_up()
    learner.learn(40)
    return learner


@pytest.mark.parametrize("n", [1, 7])
def test_policy_answers_as_the_learner_acts_and_stays_as_it_is(make_learner, env, n):
    learner = taught(make_learner())
    policy, observations = learner.policy(), observed(env, n)
    answers = policy(batch_of(observations)).numpy()
    assert (answers.shape, answers.dtype, policy.differs) == ((n, 2), np.float32, None)
    assert np.abs(answers).max() <= 1
    np.testing.assert_allclose(answers, [learner.act(each, -0.1) for each in observations], rtol=0, atol=1e-6)
    learner.learn(40)
    np.testing.assert_array_equal(policy(batch_of(observations)).numpy(), answers)
    assert np.abs(learner.policy()(batch_of(observations)).numpy() - answers).max() > 1e-5


def test_policy_is_written_as_onnx_for_batches_of_every_size(make_learner, env, tmp_path):
    policy, observations = taught(make_learner()).policy(), observed(env)
    batch = batch_of(observations)
    save_onnx(export_program(policy, batch_of(observations[:2])), batch, tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    names = {OBSERVATION if name == FLAT else name for name in parts_of(observations[0])}
    assert {each.name for each in session.get_inputs()} == names
    for some in (observations[:1], observations):
        parts = parts_of(batch_of(some))
        given = {OBSERVATION if name == FLAT else name: part.numpy() for name, part in parts.items()}
        (answers,) = session.run([NEXT_ACTION], given)
        np.testing.assert_allclose(answers, policy(batch_of(some)).numpy(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("algorithm", ["sac", "ppo"], indirect=True)
def test_policy_of_a_learner_with_stochastic_evaluation_is_its_deterministic_action(make_learner, env):
    learner = taught(make_learner(deterministic_eval=False))
    other = make_learner()
    other.load_weights(learner.weights())
    (observation,) = observed(env, 1)
    answer = learner.policy()(batch_of([observation])).numpy()[0]
    np.testing.assert_allclose(answer, other.act(observation, 0.0), rtol=0, atol=1e-6)
    assert "samples its actions" in learner.policy().differs


def test_policy_computes_in_32_bits_where_the_learner_does_not(algorithm, factory_and_network, phantom, env):
    env_factory, network = factory_and_network
    learners = [
        algorithm(network).agent(setup_for(env_factory, phantom, compute=Compute("cpu", precision=precision)))
        for precision in ("bfloat16", "float32")
    ]
    learners[1].load_weights(learners[0].weights())
    observations = observed(env)
    answers = [learner.policy()(batch_of(observations)).numpy() for learner in learners]
    np.testing.assert_array_equal(*answers)
    assert learners[0].policy().differs == "the agent has computed with bfloat16 on cpu"
    acted = np.array([learners[0].act(each, 0.0) for each in observations])
    assert 0 < np.abs(acted - answers[0]).max() < 0.05


@pytest.mark.slow
def test_policy_of_a_compiled_network_is_a_plain_one(phantom):
    from armscan.agents import SAC

    env_factory, network = ENV_FACTORIES["vector"]
    setup = setup_for(env_factory, phantom, compute=Compute("cpu", compile=True))
    learner = SAC(network=network, num_envs=2, learning_starts=20, batch_size=16).agent(setup)
    observations = observed(env_factory.make_env([phantom]))
    acted = [learner.act(each, 0.0) for each in observations]
    policy = learner.policy()
    assert policy.actor._compiled_call_impl is None
    np.testing.assert_allclose(policy(batch_of(observations)).numpy(), acted, rtol=0, atol=1e-6)
    export_program(policy, batch_of(observations))


class Fussy(nn.Module):
    """An actor whose control flow depends on values, which cannot be exported."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(15, 2)

    def forward(self, observations):
        mean = self.layer(observations)
        return (mean if float(mean.sum()) > 0 else -mean, mean), None


def test_network_that_cannot_be_written_down_is_named_in_one_line():
    policy = Policy(Fussy(), torch.tanh, Compute("cpu"))
    with pytest.raises(ExportError, match=r"^torch\.export cannot take the agent's network: ") as raised:
        export_program(policy, torch.zeros(2, 15))
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 400
