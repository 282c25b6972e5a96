"""Actions of many observations at once, each the same as alone."""

import numpy as np
import pytest
import torch
from tianshou.utils.net.common import MLP, Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic
from torch import nn

from armscan.agents.compute import Compute
from armscan.agents.inference import Inference, linear_rows


class Dropout(Net):
    """A network whose answers are random while it trains."""

    def __init__(self):
        super().__init__(state_shape=(3,), hidden_sizes=[16])
        self.model.model.append(nn.Dropout())


class Standardised(nn.Linear):
    """A linear layer whose weights have the mean 0."""

    def forward(self, inputs):
        return nn.functional.linear(inputs, self.weight - self.weight.mean(), self.bias)


class Residual(MLP):
    """Layers whose output is added to their first one's."""

    def forward(self, observations):
        first = self.model[0](torch.as_tensor(observations))
        return first + self.model[1:](first)


def residual():
    net = Net(state_shape=(3,), hidden_sizes=[16, 16])
    net.model = Residual(input_dim=3, hidden_sizes=[16, 16])
    return net


def hooked():
    net = Net(state_shape=(3,), hidden_sizes=[16])
    net.model.register_forward_pre_hook(lambda _, inputs: (torch.as_tensor(inputs[0]).clamp(-0.1, 0.1),))
    return net


NETWORKS = {
    "own layer": lambda: (Net(state_shape=(3,), hidden_sizes=[16], linear_layer=Standardised), True),
    "own layers": lambda: (residual(), True),
    "hook": lambda: (hooked(), True),
    "spectral norm": lambda: (
        Net(state_shape=(3,), hidden_sizes=[16], linear_layer=lambda n, m: nn.utils.spectral_norm(nn.Linear(n, m))),
        True,
    ),
    "plain": lambda: (Net(state_shape=(3,), hidden_sizes=[16]), True),
    "bounded by tanh": lambda: (Net(state_shape=(3,), hidden_sizes=[16]), False),
    "softmax": lambda: (Net(state_shape=(3,), hidden_sizes=[16], action_shape=(16,), softmax=True), True),
    "no bias": lambda: (
        Net(state_shape=(3,), hidden_sizes=[16], linear_layer=lambda n, m: nn.Linear(n, m, bias=False)),
        True,
    ),
    "dropout": lambda: (Dropout(), True),
}


@pytest.mark.parametrize("network", NETWORKS)
def test_actions_are_the_mean_of_the_actor_as_it_is_evaluated(network):
    torch.manual_seed(0)
    preprocess, is_unbounded = NETWORKS[network]()
    actor = ContinuousActorProbabilistic(preprocess_net=preprocess, action_shape=(2,), unbounded=is_unbounded)
    for parameter in actor.parameters():
        nn.init.normal_(parameter)
    observations = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    actions = Inference(actor, lambda mean: mean, Compute()).actions(observations, range(5))
    assert actor.training
    with torch.no_grad():
        (wanted, _), _ = actor.eval()(observations)
    np.testing.assert_allclose(actions, wanted.numpy(), rtol=1e-5, atol=1e-5)


def test_linear_rows_are_torchs_to_rounding():
    rng = np.random.default_rng(0)
    rows, weights, bias = (rng.normal(size=shape).astype(np.float32) for shape in ((5, 19), (33, 19), (33,)))
    wanted = torch.nn.functional.linear(*map(torch.from_numpy, (rows, weights, bias))).numpy()
    np.testing.assert_allclose(linear_rows(rows, weights, bias), wanted, rtol=0, atol=1e-5)


def test_linear_rows_do_not_depend_on_one_another():
    rng = np.random.default_rng(1)
    rows, weights, bias = (rng.normal(size=shape).astype(np.float32) for shape in ((67, 130), (71, 130), (71,)))
    together = linear_rows(rows, weights, bias)
    for n in (1, 2, 3, 8, 33):
        np.testing.assert_array_equal(linear_rows(rows[:n].copy(), weights, bias), together[:n])
    for row in range(len(rows)):
        np.testing.assert_array_equal(linear_rows(rows[row : row + 1], weights, bias)[0], together[row])


def test_linear_rows_take_layers_of_a_single_unit():
    rows, weights, bias = np.ones((2, 1), np.float32), np.full((1, 1), 3.0, np.float32), np.ones(1, np.float32)
    assert linear_rows(rows, weights, bias).tolist() == [[4.0], [4.0]]
