"""Factories of environments with their wrappers, single and vectorised."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from gymnasium.vector import VectorEnv

from armscan.anatomy import PUBLISHED_TARGETS, check_tissues, fitted_reward
from armscan.envs.env import ArmscanEnv
from armscan.envs.history import MAX_KEPT, boxes_of, check_exclusions
from armscan.envs.rules import Rules, Volumes
from armscan.envs.scene import RandomTransform
from armscan.envs.vector_env import ArmscanVectorEnv
from armscan.envs.wrappers import BestActionMemory, Env, FrameStack, VectorBestActionMemory, VectorFrameStack
from armscan.errors import InvalidValueError, listed
from armscan.utils.validation import check_bool, check_int
from armscan.volumes import LabelVolume

AnyEnv = TypeVar("AnyEnv", bound=Env | VectorEnv[Any, Any, Any])


class EnvFactory:
    """Makes environments that differ only in their volumes.

    Args:
        **rules: Rules of every environment, as keyword arguments of `make_armscan_env`.

    Raises:
        InvalidValueError: If there is no such rule.
    """

    def __init__(self, **rules: Any) -> None:
        allowed = [name for env_factory in (Rules, make_armscan_env) for name in _keywords(env_factory)]
        if unknown := [name for name in rules if name not in allowed]:
            raise InvalidValueError(f"env has no rule {unknown[0]!r}, but only {listed(allowed)}")
        self.rules = rules

    def fit(self, volumes: Mapping[str, LabelVolume]) -> EnvFactory:
        """Return a factory whose reward is fitted to these volumes; its environments may have other volumes."""
        tissues = check_tissues(self.rules.get("clustering", "pixels"))
        given = self.rules.get("reward"), self.rules.get("targets", PUBLISHED_TARGETS)
        reward = fitted_reward(*given, volumes.values(), tissues)
        return EnvFactory(**self.rules | {"reward": reward, "targets": PUBLISHED_TARGETS})

    def undeformed(self) -> EnvFactory:
        """Return a factory of environments that move volumes without deforming them, as evaluations do."""
        transform = self.rules.get("transform")
        if not isinstance(transform, RandomTransform):
            return self
        return EnvFactory(**self.rules | {"transform": transform.rigid})

    def make_env(self, volumes: Volumes, *, render_mode: str | None = None) -> Env:
        """Make one environment."""
        return make_armscan_env(volumes, render_mode=render_mode, **self.rules)

    def make_vector_env(self, num_envs: int, volumes: Volumes) -> VectorEnv[Any, Any, Any]:
        """Make a vector environment without autoreset on these volumes, as Tianshou's collectors need it."""
        return make_armscan_vector_env(num_envs, volumes, autoreset_mode="Disabled", **self.rules)


def make_armscan_env(
    volumes: Volumes = None,
    *,
    stack: int = 1,
    stack_exclude: Sequence[str] = (),
    memory: int = 0,
    stack_memory: bool = False,
    **kwargs: Any,
) -> Env:
    """Make an environment with its wrappers, as `gymnasium.make("armscan/Armscan-v0", ...)` does.

    Args:
        volumes: Volumes of the environment; see `ArmscanEnv`. Default: None, four phantoms.
        stack: Number of latest observations to stack, from 1 to 1000. Default: 1, no stacking.
        stack_exclude: Parts of a `Dict` observation that are not stacked. Default: none.
        memory: Number of best (action, reward) pairs to add, from 0 to 1000. Default: 0.
        stack_memory: Whether to stack the memory with the rest, instead of adding it after the stack. Default: False.
        **kwargs: Other arguments of `ArmscanEnv`.
    """
    return _wrapped(ArmscanEnv(volumes, **kwargs), stack, stack_exclude, memory, stack_memory)


def make_armscan_vector_env(num_envs: int = 1, volumes: Volumes = None, **kwargs: Any) -> VectorEnv[Any, Any, Any]:
    """Make a vector environment with its wrappers, as `gymnasium.make_vec("armscan/Armscan-v0", ...)` does.

    Args:
        num_envs: Number of environments. Default: 1.
        volumes: Volumes of the environments; see `ArmscanEnv`. Default: None, four phantoms.
        **kwargs: Arguments of `make_armscan_env` for wrappers, and other arguments of `ArmscanVectorEnv`.
    """
    wrappers = {name: kwargs.pop(name) for name in _keywords(make_armscan_env) if name in kwargs}
    return _wrapped(ArmscanVectorEnv(num_envs, volumes, **kwargs), **wrappers)


def vectorise(env: Env, num_envs: int) -> VectorEnv[Any, Any, Any]:
    """Return a vector environment with the rules and wrappers of a single one, without autoreset.

    Args:
        env: An `ArmscanEnv` with the wrappers of `make_armscan_env`.
        num_envs: Number of environments.

    Raises:
        InvalidValueError: If `env` has other wrappers, or is another environment.
    """
    if isinstance(env, ArmscanEnv):
        return ArmscanVectorEnv.sharing(env.rules, num_envs)
    if isinstance(env, FrameStack | BestActionMemory):
        form = VectorFrameStack if isinstance(env, FrameStack) else VectorBestActionMemory
        wrapped: VectorEnv[Any, Any, Any] = form(vectorise(env.env, num_envs), **env.arguments)
        return wrapped
    raise InvalidValueError(
        f"env is {env!r}, but it must be an ArmscanEnv, alone or in the wrappers FrameStack and BestActionMemory"
    )


def _wrapped(
    bare: AnyEnv, stack: int = 1, stack_exclude: Sequence[str] = (), memory: int = 0, stack_memory: bool = False
) -> AnyEnv:
    """Return a single or vector environment in the requested wrappers."""
    env: Any = bare
    is_vector = isinstance(env, VectorEnv)
    is_stacked = check_int("stack", stack, at_least=1, at_most=MAX_KEPT) > 1
    has_memory = check_int("memory", memory, at_least=0, at_most=MAX_KEPT) > 0
    keep_best = VectorBestActionMemory if is_vector else BestActionMemory
    check_bool("stack_memory", stack_memory)
    if has_memory and stack_memory:
        env = keep_best(env, memory)
    if is_stacked:
        env = (VectorFrameStack if is_vector else FrameStack)(env, stack, exclude=stack_exclude)
    if has_memory and not stack_memory:
        env = keep_best(env, memory)
    if not is_stacked:
        space = env.single_observation_space if is_vector else env.observation_space
        check_exclusions(stack_exclude, boxes_of(space, "FrameStack"))
    wrapped: AnyEnv = env
    return wrapped


def _keywords(env_factory: Callable[..., Any]) -> list[str]:
    """Return the names of keyword-only arguments."""
    parameters = inspect.signature(env_factory).parameters.values()
    return [parameter.name for parameter in parameters if parameter.kind is inspect.Parameter.KEYWORD_ONLY]
