"""Measure gradient steps of many SAC learners per second: on one GPU, and on CPU cores.

    python -m benchmarks.speed.population [--seconds S]

Every batch has 256 transitions. Two ways are measured:

- Processes: each process trains one learner on one thread, as a worker of a study does. All of them share the GPU, or
  each has a CPU core, with armscan's compiled update for vectors.
- Stacked (GPU only): each layer's parameters of all learners are one tensor, so that a layer of all learners is one
  batched matrix product. One CUDA graph is a gradient step of each learner. Each learner has a replay buffer of its
  own, in the GPU's memory.
"""

from __future__ import annotations

import argparse
import itertools
import os
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.arguments import parser_of
from benchmarks.repository import REPOSITORY
from benchmarks.speed.checkouts import ask_all, serve, start
from benchmarks.tables import print_head, print_row

BATCH_SIZE, N_STORED, N_ACTION, HIDDEN, N_TWINS = 256, 20_000, 4, (64, 64), 2
GAMMA, TAU, LR, TARGET_ENTROPY = 0.9, 0.005, 1e-3, -8.0
STACK_SIZES, N_PROCESSES = (1, 16, 64, 256, 1024), (1, 4, 16)
CASES = ("cluster, 64-64", "slice_channels 48 x 36")


class StackedMLPs(nn.Module):
    """Fully connected networks with ReLU, side by side.

    Args:
        n: Number of networks.
        sizes: Units of input, hidden layers and output.
    """

    def __init__(self, n: int, *sizes: int) -> None:
        super().__init__()
        shapes = list(itertools.pairwise(sizes))
        self.weights = nn.ParameterList([torch.randn(n, a, b) * (2 / a) ** 0.5 for a, b in shapes])
        self.biases = nn.ParameterList([torch.zeros(n, 1, b) for _, b in shapes])

    def forward(self, x: Tensor) -> Tensor:
        """Return the outputs, shape (n, batch, outputs), for inputs of shape (n, batch, inputs)."""
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weights, biases in hidden:
            x = torch.relu(torch.baddbmm(biases, x, weights))
        return torch.baddbmm(last[1], x, last[0])


class Population:
    """SAC learners with learned entropy coefficients, stacked on one device.

    Args:
        n: Number of learners.
        n_features: Length of an observation.
        device: Name of the device.
    """

    def __init__(self, n: int, n_features: int, device: str) -> None:
        self.n, self.device = n, device
        self.actor = StackedMLPs(n, n_features, *HIDDEN, 2 * N_ACTION).to(device)
        self.critics, self.targets = (
            StackedMLPs(N_TWINS * n, n_features + N_ACTION, *HIDDEN, 1).to(device) for _ in range(2)
        )
        self.targets.load_state_dict(self.critics.state_dict())
        self.log_alpha = torch.full((n, 1), 0.1, device=device).log_().requires_grad_()
        self.obs, self.next_obs = (torch.randn(n, N_STORED, n_features, device=device) for _ in range(2))
        self.actions = torch.rand(n, N_STORED, N_ACTION, device=device) * 2 - 1
        self.rewards, self.not_terminated = (
            torch.randn(n, N_STORED, device=device),
            torch.ones(n, N_STORED, device=device),
        )
        options: dict[str, Any] = {"lr": LR, "fused": True, "capturable": device == "cuda"}
        parts = (self.actor.parameters(), self.critics.parameters(), [self.log_alpha])
        self.adams = [torch.optim.Adam(parameters, **options) for parameters in parts]

    def update(self) -> None:
        """Take one gradient step of each learner, each with a batch of its own."""
        chosen = torch.randint(N_STORED, (self.n, BATCH_SIZE), device=self.device)
        each = torch.arange(self.n, device=self.device)[:, None]
        obs, next_obs, actions = self.obs[each, chosen], self.next_obs[each, chosen], self.actions[each, chosen]
        alpha = self.log_alpha.exp().detach()
        with torch.no_grad():
            next_actions, next_log_prob = self._sampled(next_obs)
            values = self._values(self.targets, next_obs, next_actions).amin(0) - alpha * next_log_prob
            returns = self.rewards[each, chosen] + GAMMA * self.not_terminated[each, chosen] * values
        # Sums over learners: no learner's gradient depends on another.
        errors = self._values(self.critics, obs, actions) - returns
        self._step(1, errors.square().mean(2).sum())
        new_actions, log_prob = self._sampled(obs)
        new_values = self._values(self.critics, obs, new_actions).amin(0)
        self._step(0, (alpha * log_prob - new_values).mean(1).sum())
        self._step(2, -(self.log_alpha * (log_prob.detach() + TARGET_ENTROPY)).mean(1).sum())
        with torch.no_grad():
            torch._foreach_lerp_(list(self.targets.parameters()), list(self.critics.parameters()), TAU)

    def _sampled(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self.actor(obs).chunk(2, dim=2)
        std = log_std.clamp(-20.0, 2.0).exp()
        noise = torch.randn_like(mean)
        raw = mean + std * noise
        log_prob = -noise.square() / 2 - std.log() - 0.9189385332046727
        # log(1 - tanh(x)^2), stable.
        squashed = 2.0 * (0.6931471805599453 - raw - functional.softplus(-2.0 * raw))
        return torch.tanh(raw), (log_prob - squashed).sum(2)

    def _values(self, critics: StackedMLPs, obs: Tensor, actions: Tensor) -> Tensor:
        pairs = torch.cat([obs, actions], dim=2)
        return critics(torch.cat([pairs] * N_TWINS)).view(N_TWINS, self.n, -1)

    def _step(self, part: int, loss: Tensor) -> None:
        adam = self.adams[part]
        own = adam.param_groups[0]["params"]
        for weights, gradient in zip(own, torch.autograd.grad(loss, own), strict=True):
            weights.grad = gradient
        adam.step()


def graph_of(population: Population) -> Callable[[], None]:
    """Return a function that takes one gradient step of each learner as one CUDA graph."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            population.update()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        population.update()
    return graph.replay


def stacked_gradient_steps_per_s(n: int, n_features: int, seconds: float) -> float:
    """Return the gradient steps per second of `n` stacked learners together."""
    update = graph_of(Population(n, n_features, "cuda"))
    torch.cuda.synchronize()
    n_updates, start_s = 0, time.perf_counter()
    while time.perf_counter() - start_s < seconds:
        for _ in range(20):
            update()
        torch.cuda.synchronize()
        n_updates += 20
    return n * n_updates / (time.perf_counter() - start_s)


def gradient_steps_per_s(case: str) -> float:
    """Return the gradient steps per second of one learner, for a request `CASE; DEVICE; SECONDS`."""
    from armscan.agents import Compute
    from benchmarks.speed import updates

    name, device, seconds = case.split("; ")
    if (name, device) not in _UPDATERS:
        torch.set_num_threads(1)
        _UPDATERS[name, device] = updates.updater(*updates.CASES[name], Compute(device), by_tianshou=False)
    return _UPDATERS[name, device](float(seconds))


_UPDATERS: dict[tuple[str, str], Callable[[float], float]] = {}


def main() -> None:
    """Print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=5.0, help="of each measurement (default: 5)")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        serve(gradient_steps_per_s)
        return
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    print_head("learners", "device", "processes", "gradient steps/s together", "of one process")
    for case in CASES:
        for device in devices:
            for n in (each for each in N_PROCESSES if each <= (os.cpu_count() or 1)):
                processes = [start(__file__, REPOSITORY) for _ in range(n)]
                try:
                    ask_all(processes, f"{case}; {device}; 0.0")
                    rates = ask_all(processes, f"{case}; {device}; {given.seconds}")
                finally:
                    for process in processes:
                        process.kill()
                        process.wait()
                print_row(case, device, n, f"{sum(rates):,.0f}", f"{sum(rates) / n:,.1f}")
    if "cuda" in devices:
        n_features = _n_features()
        print_head("stacked learners, 64-64", "gradient steps/s together", "of each learner")
        for n in STACK_SIZES:
            rate = stacked_gradient_steps_per_s(n, n_features, given.seconds)
            print_row(n, f"{rate:,.0f}", f"{rate / n:,.1f}")


def _n_features() -> int:
    from armscan.volumes import load_phantoms
    from benchmarks.speed import updates

    env = updates.CASES[CASES[0]][0].make_env(load_phantoms(range(1)))
    assert env.observation_space.shape is not None
    return env.observation_space.shape[0]


if __name__ == "__main__":
    main()
