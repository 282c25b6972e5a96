"""The learner of the plane finder: trains a network on the looks that it chooses itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from armscan.agents.base_learner import SupervisedLearner, diverged, labelled_envs_of
from armscan.agents.finder_parameters import FinderParameters
from armscan.agents.look_network import ACTION, IMAGE, FinderModule, LookNetwork, looks_of
from armscan.agents.plane_geometry import common_geometry
from armscan.agents.policy import batch_of
from armscan.agents.protocols import AgentSetup
from armscan.envs.actions import ActionBounds
from armscan.envs.history import rows_of
from armscan.envs.rules import Observed
from armscan.envs.vector_env import reset_each
from armscan.errors import InvalidValueError
from armscan.utils.arrays import FloatArray
from armscan.volumes.phantom.generate import PHANTOM_NAME

# Perturbed looks: range of the standard deviations, in mm and degrees, which are drawn log-uniformly.
PERTURBED_MM, PERTURBED_DEG = (0.5, 6.0), (1.0, 8.0)
# Factors on the loss thresholds for the first look: two tilts, distance along the normal, position across.
FIRST_LOOK = (2.0, 2.0, 5.0, 1.0)
# Weight of the second head's loss relative to the first's.
EXPECTED_ERROR_WEIGHT = 0.1
# Episodes that the expected errors are calibrated on.
N_CALIBRATION = 96
# Each round of the calibration halves the distance to its result.
N_CALIBRATION_ROUNDS = 24


class PlaneFinderLearner(SupervisedLearner):
    """Plays episodes in all environments at once, and takes a gradient step on all their looks.

    Args:
        finder: Parameters of the agent.
        setup: Environments, spaces, budget and seed of the agent.
    """

    def __init__(self, finder: FinderParameters, setup: AgentSetup) -> None:
        self._finder, self._has_stop = finder, len(setup.action_names) > 4
        envs = setup.make_envs(finder.num_envs)
        self._env_steps_per_update = envs.num_envs * finder.n_looks
        torch.manual_seed(setup.seed)
        space: Any = setup.observation_space
        network = LookNetwork(space[IMAGE].shape[1:], finder)
        geometry = common_geometry(labelled_envs_of(envs).rules, finder.n_looks)
        self._module = FinderModule(network, geometry, finder, has_stop=self._has_stop)
        super().__init__(self._module, finder.lr, envs, setup)
        # Not to the module, whose forward learning bypasses, and whose geometry requires 32 bits.
        setup.compute.apply_to(network)
        self._calibration_envs = setup.make_validation_envs and setup.make_validation_envs(N_CALIBRATION)
        self.expected_error: tuple[float, float] | None = None
        """Expected errors of the plane found so far, at the latest `act`, in mm and degrees; None before it, and if SAC
        corrects planes."""
        self.expected_errors: NDArray[Any] = np.empty((0, 2))
        """Expected errors of the planes found so far, at the latest `act_all`, shape (n, 2); None for an episode
        without."""

    @property
    def env_steps_at_once(self) -> int:
        """All looks of an episode in each environment."""
        return self._env_steps_per_update

    def _learn_until(self, n_env_steps: int, seeds: list[int], rng: np.random.Generator) -> list[Tensor]:
        """See `SupervisedLearner._learn_until`."""
        losses: list[Tensor] = []
        while self._n_env_steps < n_env_steps:
            observations, _ = reset_each(self._envs, None if losses else seeds, self._volumes(rng, self._envs.num_envs))
            losses.append(self._gradient_step(observations, rng))
            self._n_env_steps += self._env_steps_per_update
        return losses

    def _volumes(self, rng: np.random.Generator, n_episodes: int) -> dict[str, Any] | None:
        """Draw the volume of each episode by `phantom_share`; None leaves the choice to the environments."""
        phantom_share, names = self._finder.phantom_share, self._labelled_envs.rules.names
        phantoms = [name for name in names if PHANTOM_NAME.fullmatch(name)]
        groups = phantoms, [name for name in names if name not in phantoms]
        if phantom_share is None or not all(groups):
            return None
        chosen = (rng.random(n_episodes) >= phantom_share).astype(int)
        return {"volume": [groups[each][int(rng.integers(len(groups[each])))] for each in chosen]}

    def _gradient_step(self, observations: Observed, rng: np.random.Generator) -> Tensor:
        """Play an episode in every environment, and take a gradient step on its looks."""
        optima = self._optima(self._envs)
        seen = [self._tensors(observations)]
        for offset_mm in self._finder.offsets_mm[:-1]:
            observations = self._envs.step(self._next_looks(seen[-1], offset_mm, rng))[0]
            seen.append(self._tensors(observations))
        looks = {name: torch.cat([each[name] for each in seen]) for name in (IMAGE, ACTION)}
        planes, place, expected, step, _ = self._module.estimate(looks)
        wanted = self._module.geometry.seen_from(planes, optima.repeat(len(seen), 1))
        finder = self._finder
        tilt = math.radians(finder.loss_deg)
        scale = wanted.new_tensor([tilt, tilt, finder.loss_mm, finder.loss_across_mm])
        scale = torch.where(step[:, :1] > 0.0, scale * wanted.new_tensor(FIRST_LOOK), scale)
        loss = len(seen) * nn.functional.smooth_l1_loss(place / scale, wanted / scale, reduction="none").mean(0).sum()
        off = (place - wanted).detach()
        errors = torch.stack([off[:, 2].abs(), torch.rad2deg(off[:, :2].norm(dim=1))], dim=1)
        # The network's own: what it learns must not depend on how often it was calibrated.
        expected = expected / self._module.calibration
        # Negative log-likelihood of errors from an exponential distribution with this mean.
        expected_error_loss = (expected.log() + errors / expected).mean()
        self._set_lr(finder.lr_after(self._n_env_steps, self._total_env_steps))
        self._optimiser.zero_grad()
        torch.autograd.backward(loss + EXPECTED_ERROR_WEIGHT * expected_error_loss)
        self._optimiser.step()
        return loss.detach()

    def _next_looks(self, seen: dict[str, Tensor], offset_mm: float, rng: np.random.Generator) -> FloatArray:
        """Return the next looks beside the planes found so far, some of them perturbed, as actions that never stop."""
        n = self._envs.num_envs
        draws = torch.as_tensor(rng.normal(size=(n, 4)), dtype=torch.float32, device=self._device)
        stds = np.exp([rng.uniform(math.log(low), math.log(high), n) for low, high in (PERTURBED_DEG, PERTURBED_MM)])
        is_perturbed = rng.random(n) < self._finder.perturbed_share
        perturbed_deg, perturbed_mm = torch.as_tensor(stds * is_perturbed, dtype=torch.float32, device=self._device)
        with torch.no_grad():
            plane, place, *_ = self._module.estimate(seen)
            tilt = torch.deg2rad(perturbed_deg)[:, None] * draws[:, :2]
            place = torch.cat([place[:, :2] + tilt, place[:, 2:]], dim=1)
            beside_mm = offset_mm + perturbed_mm * draws[:, 2]
            geometry = self._module.geometry
            actions = geometry.actions(geometry.from_frame(plane, place, beside_mm)).cpu().numpy()
        if not np.isfinite(actions).all():
            raise diverged(self._n_env_steps)
        return np.column_stack([actions, np.full(n, -1.0)]) if self._has_stop else actions

    def _further_metrics(self, seed: int) -> dict[str, float]:
        """Calibrate the expected errors to be right on average on the validation volumes; return the metrics there."""
        if self._calibration_envs is None:
            return {}
        expected_at_looks, errors_at_looks = self._answers(self._calibration_envs, seed)
        episodes = torch.arange(errors_at_looks.shape[1], device=self._device)
        for _ in range(N_CALIBRATION_ROUNDS):
            # The factor decides where the agent is sure enough to stop, and the answers there decide the factor.
            is_last = self._module.is_sure(expected_at_looks * self._module.calibration)
            is_last[-1] = True
            last = is_last.int().argmax(0)
            expected, errors = expected_at_looks[last, episodes], errors_at_looks[last, episodes]
            factor = errors.mean(0) / expected.mean(0).clamp(min=1e-6)
            # Halfway on a logarithmic scale, because whole steps may swing between two factors for ever.
            self._module.calibration.copy_((self._module.calibration * factor).sqrt())
        metrics = {}
        for i, unit in enumerate(("mm", "deg")):
            order = expected[:, i].argsort()
            surest, least = order[: len(order) // 4], order[-(len(order) // 4) :]
            metrics[f"calibration/error_{unit}"] = float(errors[:, i].mean())
            metrics[f"calibration/error_{unit}_surest_quarter"] = float(errors[surest, i].mean())
            metrics[f"calibration/error_{unit}_least_sure_quarter"] = float(errors[least, i].mean())
            metrics[f"calibration/factor_{unit}"] = float(self._module.calibration[i])
        return metrics

    @torch.no_grad()
    def _answers(self, envs: Any, seed: int) -> tuple[Tensor, Tensor]:
        """Play episodes in which the agent is never sure.

        Returns:
            The expected error before calibration, and the error, of the plane that the agent would answer at each look,
            both of shape (n_looks, episodes, 2).
        """
        module, answers = self._module, []
        observations, _ = reset_each(envs, seed)
        optima = self._optima(envs)
        for _ in range(self._finder.n_looks):
            estimate = module.found(self._tensors(observations))
            sure, unsure = (
                module.actions(estimate._replace(expected=torch.full_like(estimate.expected, error)))
                for error in (-math.inf, math.inf)
            )
            errors = module.geometry.errors(module.geometry.planes(sure[:, :4]), optima)
            answers.append((estimate.expected / module.calibration, errors))
            observations = envs.step(unsure.cpu().numpy())[0]
        expected_at_looks, errors_at_looks = zip(*answers, strict=True)
        return torch.stack(expected_at_looks), torch.stack(errors_at_looks)

    def _optima(self, envs: Any) -> Tensor:
        """Return the labelled planes of the current episodes, shape (num_envs, 4)."""
        optima = torch.as_tensor(
            labelled_envs_of(envs).optimal_actions[:, :4], dtype=torch.float32, device=self._device
        )
        planes: Tensor = self._module.geometry.planes(optima)
        return planes

    def _tensors(self, observations: Any) -> dict[str, Tensor]:
        return looks_of(observations, self._device)

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """Begin an episode, in which nothing is drawn.

        Raises:
            InvalidValueError: If the bounds, and so the meaning of actions, differ from training.
        """
        given, known = (*bounds.rotation_deg, *bounds.translation_mm), self._module.geometry.bounds.tolist()
        if not np.allclose(given, known, atol=1e-3):
            raise InvalidValueError(
                f"the bounds of the actions are {given}, but this plane finder has learned with {tuple(known)}: give "
                "them with env.rotation_bounds_deg and env.translation_bounds_mm"
            )

    def act(self, observation: Observed, reward: float) -> FloatArray:
        """Return the next plane, shape (n_action,)."""
        batch = batch_of([observation])
        with torch.no_grad():
            (actions, expected), _ = self._network(self._tensors(batch))
        self.expected_error = (float(expected[0, 0]), float(expected[0, 1]))
        return np.asarray(actions[0].clamp(-1.0, 1.0).cpu().numpy())

    def begin_all(self, *, seeds: Sequence[int], bounds: Sequence[ActionBounds]) -> None:
        """See `BatchAgent.begin_all`."""
        for seed, its_bounds in zip(seeds, bounds, strict=True):
            self.begin(seed=seed, bounds=its_bounds)
        self.expected_errors = np.full((len(seeds), 2), None)

    def act_all(self, observations: Observed, rewards: FloatArray, episodes: NDArray[np.int64]) -> FloatArray:
        """See `BatchAgent.act_all`; one by one, because convolutions of a larger batch differ in the last bits."""
        actions = []
        for row, (episode, reward) in enumerate(zip(episodes.tolist(), rewards.tolist(), strict=True)):
            actions.append(self.act(rows_of(observations, row), reward))
            self.expected_errors[episode] = self.expected_error
        return np.array(actions)
