"""A gradient step of SAC for fully connected networks with ReLU, compiled.

A critic has one head, an actor two: mean and log standard deviation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armscan.agents.mlp_kernels import (
    Adam,
    F,
    Floats,
    Ints,
    Layers,
    Weights,
    adam_step,
    backward,
    fast_njit,
    forward,
    input_gradient,
    layer_view,
    linear,
    linear_gradient,
)
from armscan.utils.arrays import FloatArray

# Tianshou's bounds of the log standard deviation, and its constant that keeps log(1 - tanh(x)^2) finite.
LOG_STD_MIN, LOG_STD_MAX, EPS = F(-20.0), F(2.0), np.finfo(np.float32).eps
LOG_SQRT_2PI = F(0.5 * math.log(2.0 * math.pi))


class Transitions(NamedTuple):
    """All transitions of a replay buffer, along the first axis of each array."""

    obs: Floats
    obs_next: Floats
    act: Floats
    rew: NDArray[np.float64]
    terminated: NDArray[np.bool_]


class Drawn(NamedTuple):
    """Sampled actions with their (log) standard deviations, shape (n, n_action), and log-probabilities, shape (n,)."""

    log_std: Floats
    std: Floats
    actions: Floats
    log_prob: Floats


class Entropy(NamedTuple):
    """The entropy coefficient; a fixed one has a learning rate of 0."""

    log_alpha: Weights
    adam: Adam
    target: float


class SACState(NamedTuple):
    """Networks and settings of SAC; `targets` are the target critics."""

    actor: Weights
    critics: tuple[Weights, Weights]
    targets: tuple[Floats, Floats]
    adams: tuple[Adam, Adam, Adam]
    entropy: Entropy
    gamma: float
    tau: float


@fast_njit
def _act(actor: Weights, layers: Layers, noise: Floats) -> Drawn:
    """Sample an action for each observation in the actor's input layer."""
    n, n_action = noise.shape
    log_std, std, actions = np.empty((n, n_action), F), np.empty((n, n_action), F), np.empty((n, n_action), F)
    log_prob = np.zeros(n, F)
    mean_head = forward(actor.values, layers, n)
    features = layer_view(layers.values, layers.sizes, n, layers.sizes.size - 1)
    std_head = linear(features, actor.values, mean_head, actions, False)
    linear(features, actor.values, std_head, log_std, False)
    for i in range(n):
        for j in range(n_action):
            log_s = min(max(log_std[i, j], LOG_STD_MIN), LOG_STD_MAX)
            std[i, j] = np.exp(log_s)
            actions[i, j] = np.tanh(actions[i, j] + std[i, j] * noise[i, j])
            log_prob[i] -= F(0.5) * noise[i, j] * noise[i, j] + log_s + LOG_SQRT_2PI
            log_prob[i] -= np.log(F(1.0) - actions[i, j] * actions[i, j] + EPS)
    return Drawn(log_std, std, actions, log_prob)


@fast_njit
def _fill_input(layers: Layers, obs: Floats, actions: Floats) -> None:
    """Fill the critics' input layer."""
    n, n_obs = obs.shape
    x = layer_view(layers.values, layers.sizes, n, 0)
    for i in range(n):
        for j in range(n_obs):
            x[i, j] = obs[i, j]
        for j in range(n_obs, x.shape[1]):
            x[i, j] = actions[i, j - n_obs]


@fast_njit
def _q_values(critic: Floats, layers: Layers, values: Floats) -> int:
    """Compute a critic's values, shape (n, 1); return where the weights of its head start."""
    n: int = values.shape[0]
    head: int = forward(critic, layers, n)
    linear(layer_view(layers.values, layers.sizes, n, layers.sizes.size - 1), critic, head, values, False)
    return head


@fast_njit
def _critic_gradient(critic: Weights, layers: Layers, head: int, d_values: Floats, of_input: bool) -> None:
    """Backpropagate the gradient of a critic's values to its input, or else to its weights."""
    n, last = d_values.shape[0], layers.sizes.size - 1
    if not of_input:
        linear_gradient(layer_view(layers.values, layers.sizes, n, last), d_values, critic.gradient, head)
    input_gradient(d_values, critic.values, head, layer_view(layers.gradient, layers.sizes, n, last))
    backward(critic, layers, n, head, of_input)


@fast_njit
def _update_critic(critic: Weights, layers: Layers, adam: Adam, td_targets: Floats) -> float:
    """Take a gradient step of a critic; return its loss."""
    n = td_targets.size
    values, d_values = np.empty((n, 1), F), np.empty((n, 1), F)
    head = _q_values(critic.values, layers, values)
    loss = 0.0
    for i in range(n):
        error = values[i, 0] - td_targets[i]
        loss += error * error
        d_values[i, 0] = F(2.0) * error / F(n)
    _critic_gradient(critic, layers, head, d_values, False)
    adam_step(critic, adam)
    return loss / n


@fast_njit
def _update_actor(
    agent: SACState, layers: Layers, critic_layers: Layers, noise: Floats, alpha: np.float32
) -> tuple[float, float]:
    """Take a gradient step of the actor; return its loss, and the mean log-probability of its actions."""
    n, n_action = noise.shape
    obs = layer_view(layers.values, layers.sizes, n, 0)
    drawn = _act(agent.actor, layers, noise)
    values, d_values, d_actions = np.empty((2, n, 1), F), np.ones((n, 1), F), np.empty((2, n, n_action), F)
    _fill_input(critic_layers, obs, drawn.actions)
    for k in range(2):
        head = _q_values(agent.critics[k].values, critic_layers, values[k])
        _critic_gradient(agent.critics[k], critic_layers, head, d_values, True)
        d_x = layer_view(critic_layers.gradient, critic_layers.sizes, n, 0)
        for i in range(n):
            for j in range(n_action):
                d_actions[k, i, j] = d_x[i, obs.shape[1] + j]

    loss = mean_log_prob = 0.0
    d_mean, d_log_std = np.empty((n, n_action), F), np.empty((n, n_action), F)
    for i in range(n):
        value1, value2 = values[0, i, 0], values[1, i, 0]
        loss += alpha * drawn.log_prob[i] - min(value1, value2)
        mean_log_prob += drawn.log_prob[i]
        # Only the smaller value has a gradient; torch halves it between equal ones.
        share = F(1.0) if value1 < value2 else F(0.5) if value1 == value2 else F(0.0)
        for j in range(n_action):
            action, log_s = drawn.actions[i, j], drawn.log_std[i, j]
            slope = F(1.0) - action * action
            d_value = share * d_actions[0, i, j] + (F(1.0) - share) * d_actions[1, i, j]
            d_mean[i, j] = (alpha * F(2.0) * action / (slope + EPS) - d_value) * slope / F(n)
            d_log_s = d_mean[i, j] * noise[i, j] * drawn.std[i, j] - alpha / F(n)
            d_log_std[i, j] = d_log_s if LOG_STD_MIN <= log_s <= LOG_STD_MAX else F(0.0)
    _actor_gradient(agent.actor, layers, d_mean, d_log_std)
    adam_step(agent.actor, agent.adams[0])
    return loss / n, mean_log_prob / n


@fast_njit
def _actor_gradient(actor: Weights, layers: Layers, d_mean: Floats, d_log_std: Floats) -> None:
    """Backpropagate the gradients of an actor's two heads to its weights."""
    n, n_action, last = d_mean.shape[0], d_mean.shape[1], layers.sizes.size - 1
    features = layer_view(layers.values, layers.sizes, n, last)
    d_features, of_std = layer_view(layers.gradient, layers.sizes, n, last), np.empty_like(features)
    n_head = n_action * (features.shape[1] + 1)
    mean_head, std_head = actor.values.size - 2 * n_head, actor.values.size - n_head
    linear_gradient(features, d_mean, actor.gradient, mean_head)
    linear_gradient(features, d_log_std, actor.gradient, std_head)
    input_gradient(d_mean, actor.values, mean_head, d_features)
    input_gradient(d_log_std, actor.values, std_head, of_std)
    for i in range(n):
        for j in range(features.shape[1]):
            d_features[i, j] += of_std[i, j]
    backward(actor, layers, n, mean_head, False)


@fast_njit
def _update_coefficient(entropy: Entropy, mean_log_prob: float) -> float:
    """Take a gradient step of the entropy coefficient; return its loss."""
    deficit = entropy.target + mean_log_prob
    loss: float = -entropy.log_alpha.values[0] * deficit
    entropy.log_alpha.gradient[0] = -deficit
    adam_step(entropy.log_alpha, entropy.adam)
    return loss


@fast_njit
def _td_targets(
    transitions: Transitions,
    index: Ints,
    obs_next: Floats,
    drawn: Drawn,
    agent: SACState,
    layers: Layers,
    alpha: np.float32,
) -> Floats:
    """Return the critics' TD targets for a batch, from the actions sampled at its next observations."""
    values, td_targets = np.empty((2, index.size, 1), F), np.empty(index.size, F)
    _fill_input(layers, obs_next, drawn.actions)
    for k in range(2):
        _q_values(agent.targets[k], layers, values[k])
    for i in range(index.size):
        future = min(values[0, i, 0], values[1, i, 0]) - alpha * drawn.log_prob[i]
        is_over = transitions.terminated[index[i]]
        td_targets[i] = transitions.rew[index[i]] + (0.0 if is_over else agent.gamma * future)
    return td_targets


@fast_njit
def _take(rows: Floats, index: Ints, out: Floats) -> None:
    """Copy the rows of a batch to `out`."""
    for i in range(index.size):
        for j in range(out.shape[1]):
            out[i, j] = rows[index[i], j]


@fast_njit
def update(
    transitions: Transitions,
    indices: Ints,
    noise: Floats,
    agent: SACState,
    actor_layers: Layers,
    critic_layers: Layers,
    losses: FloatArray,
) -> None:
    """Take k gradient steps, each of the critics, the actor and the entropy coefficient; update the targets each time.

    Args:
        transitions: All transitions of the replay buffer.
        indices: Indices of the transitions of each batch, shape (k, n).
        noise: Standard normal noise for the actions at the next and at the current observations, shape (k, 2, n,
            n_action).
        agent: Networks and settings.
        actor_layers: Memory for the actor's layers.
        critic_layers: Memory for a critic's layers.
        losses: Array to fill with the losses of actor, critics and entropy coefficient, and the coefficient, shape (k,
            5).
    """
    n, tau = indices.shape[1], F(agent.tau)
    obs, actions = layer_view(actor_layers.values, actor_layers.sizes, n, 0), np.empty(noise.shape[2:], F)
    for step, index in enumerate(indices):
        alpha = F(np.exp(agent.entropy.log_alpha.values[0]))
        _take(transitions.obs_next, index, obs)
        drawn = _act(agent.actor, actor_layers, noise[step, 0])
        td_targets = _td_targets(transitions, index, obs, drawn, agent, critic_layers, alpha)
        _take(transitions.obs, index, obs)
        _take(transitions.act, index, actions)
        _fill_input(critic_layers, obs, actions)
        for k in range(2):
            losses[step, 1 + k] = _update_critic(agent.critics[k], critic_layers, agent.adams[1 + k], td_targets)
        losses[step, 0], mean_log_prob = _update_actor(agent, actor_layers, critic_layers, noise[step, 1], alpha)
        losses[step, 3] = _update_coefficient(agent.entropy, mean_log_prob)
        losses[step, 4] = np.exp(agent.entropy.log_alpha.values[0])
        for k in range(2):
            source, target = agent.critics[k].values, agent.targets[k]
            for i in range(target.size):
                target[i] = tau * source[i] + (F(1.0) - tau) * target[i]
