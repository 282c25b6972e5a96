"""The vector environment: planes are looked at together, on all cores, without subprocesses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any, Self, cast

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from armscan.envs.episode import INFO, Episode, begin, check_actions, look, wanted_volume
from armscan.envs.history import EnvIds, Mask
from armscan.envs.rules import Observed, Rules, Volumes
from armscan.errors import InvalidValueError, ResetNeededError
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_int

MAX_ENVS = 65536
VectorStep = tuple[Observed, FloatArray, Mask, Mask, dict[str, Any]]


class ArmscanVectorEnv(VectorEnv[Any, Any, Any]):
    """`num_envs` environments on the same volumes, each with its own random generator.

    Environment i is bit-identical to an `ArmscanEnv` with the same seed. In autoreset mode `NextStep` the step after an
    episode's end resets that environment, ignoring the action, with reward 0, as Gymnasium defines it; in `Disabled`
    the caller resets finished ones by `reset(options={"reset_mask": mask})`.

    Args:
        num_envs: Number of environments, from 1 to 65,536. Default: 1.
        volumes: Volumes of the environments; see `ArmscanEnv`. Default: None, four phantoms.
        autoreset_mode: Autoreset mode of Gymnasium, `NextStep` or `Disabled`. Default: `NextStep`.
        render_mode: Must be None: rendering is not supported. Default: None.
        **rules: The other arguments of `ArmscanEnv`.

    Attributes:
        info_keys: Keys of `info`. Default: all that `ArmscanEnv` describes. Fewer keys save up to a tenth of a step;
            the wrappers require `action` and `reward`.

    Raises:
        InvalidValueError: If an argument is invalid.
        OptimalPlaneError: As `ArmscanEnv`.
    """

    metadata: dict[str, Any]

    def __init__(
        self,
        num_envs: int = 1,
        volumes: Volumes = None,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: None = None,
        **rules: Any,
    ) -> None:
        if render_mode is not None:
            raise InvalidValueError(f"render_mode is {render_mode!r}, but only a single environment renders")
        self._set_up(num_envs, _checked_mode(autoreset_mode), lambda: Rules(volumes, **rules))

    @classmethod
    def sharing(cls, rules: Rules, num_envs: int) -> Self:
        """Return a vector environment that shares another's rules and volumes, without autoreset."""
        envs = cls.__new__(cls)
        envs._set_up(num_envs, AutoresetMode.DISABLED, lambda: rules)
        return envs

    def _set_up(self, num_envs: int, autoreset_mode: AutoresetMode, make_rules: Callable[[], Rules]) -> None:
        self.info_keys: Collection[str] = tuple(INFO)
        self.num_envs = check_int("num_envs", num_envs, at_least=1, at_most=MAX_ENVS)
        self._autoreset_mode = autoreset_mode
        self.metadata = {"autoreset_mode": autoreset_mode}
        self.rules = make_rules()
        self.single_observation_space = self.rules.observation_space
        self.single_action_space = self.rules.action_space
        self.observation_space = batch_space(self.rules.observation_space, self.num_envs)
        self.action_space = batch_space(self.rules.action_space, self.num_envs)
        self._rngs, self._rng_seeds = map(list, zip(*(seeding.np_random() for _ in range(self.num_envs)), strict=True))
        self._episodes: list[Episode | None] = [None] * self.num_envs

    @property
    def np_random_seed(self) -> Any:
        """Seed of each environment's random generator, as Gymnasium's vector environments have it: a tuple."""
        return tuple(self._rng_seeds)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Start an episode in each environment, or in those that `options["reset_mask"]` marks.

        Args:
            seed: Seed of the first environment, counted up for the others, or a list with one for each. Default: None,
                the random generators go on.
            options: `volume`: name of a volume for all, or a list with one for each; `reset_mask`: environments to
                reset, booleans of shape (num_envs,). Default: None, all environments with drawn volumes.

        Returns:
            The observations and `info` of all environments; only those that were reset are marked in `info`.

        Raises:
            InvalidValueError: If `seed` or `options` is invalid.
            ResetNeededError: If an environment that is not reset has no episode yet.
        """
        options = dict(options) if isinstance(options, dict) else options
        mask = self._popped_mask(options)
        chosen = np.flatnonzero(mask)
        names, seeds = self._volume_names(options), self._seeds(seed)
        for i, one_seed in enumerate(seeds):
            if one_seed is not None and i in chosen:
                self._rngs[i], self._rng_seeds[i] = seeding.np_random(one_seed)
        self._begin(chosen, names)
        look(self.rules, self.episodes(chosen))
        episodes = self.episodes(range(self.num_envs))
        return self._observed(episodes), self._infos(episodes, mask)

    def step(self, actions: Any, env_ids: Sequence[int] | EnvIds | None = None) -> VectorStep:
        """Take a step in every environment, or in some of them.

        Args:
            actions: Actions, a row for each environment that takes a step.
            env_ids: Indices of these environments, each at most once; results have a row for each of them, in this
                order, and other environments do not change. Default: None, all environments.

        Raises:
            InvalidValueError: If the actions or `env_ids` are invalid.
            ResetNeededError: If an episode has not begun, or, without autoreset, has ended.
        """
        chosen = np.arange(self.num_envs) if env_ids is None else self._checked_ids(env_ids)
        episodes = self.episodes(chosen)
        is_over = np.array([not episode.is_running for episode in episodes])
        if self._autoreset_mode is AutoresetMode.DISABLED and is_over.any():
            raise ResetNeededError(
                f"the episodes of environments {chosen[is_over].tolist()} have ended: reset them by "
                "reset(options={'reset_mask': mask}) before step()"
            )
        shape = (len(chosen), *self.rules.action_space.shape)
        for episode, action in zip(episodes, check_actions(actions, shape), strict=True):
            if episode.is_running:
                episode.aim(action)
        self._begin(chosen[is_over], [None] * self.num_envs)
        episodes = self.episodes(chosen)
        look(self.rules, episodes)
        rewards = np.array([0.0 if over else e.view.reward for e, over in zip(episodes, is_over, strict=True)])
        terminated = np.array([episode.is_terminated for episode in episodes]) & ~is_over
        truncated = np.array([episode.is_truncated for episode in episodes]) & ~is_over
        infos = self._infos(episodes, np.ones(len(episodes), dtype=np.bool_))
        return self._observed(episodes), rewards, terminated, truncated, infos

    def episodes(self, env_ids: Sequence[int] | EnvIds) -> list[Episode]:
        """Return the current episodes of some environments: privileged, like `optimal_actions`."""
        return [self._episode(int(i)) for i in env_ids]

    @property
    def optimal_actions(self) -> FloatArray:
        """Action to the labelled plane of each current episode, normalised, shape (num_envs, n_action).

        If agents end episodes themselves (`env.ends=on_stop`), it includes the action to stop there.

        Privileged: neither observations nor `info` contain it. It is for supervised learning on training volumes.
        """
        free = list(self.rules.free)
        optima = np.ones((self.num_envs, len(self.rules.action_names)))
        optima[:, : len(free)] = [self._episode(i).scene.optimum_normalised[free] for i in range(self.num_envs)]
        return optima

    def _episode(self, i: int) -> Episode:
        episode = self._episodes[i]
        if episode is None:
            raise ResetNeededError(f"environment {i} has no episode yet: call reset() first")
        return episode

    def _begin(self, chosen: EnvIds, volume_names: Sequence[str | None]) -> None:
        if len(chosen):
            begun = begin(self.rules, [self._rngs[i] for i in chosen], [volume_names[i] for i in chosen])
            for i, episode in zip(chosen, begun, strict=True):
                self._episodes[i] = episode

    def _observed(self, episodes: Sequence[Episode]) -> Observed:
        return self.rules.observe_all([episode.view for episode in episodes])

    def _infos(self, episodes: Sequence[Episode], is_given: Mask) -> dict[str, Any]:
        """Return `info` as arrays, each `key` with a mask `_key` of the environments that have it, as in Gymnasium."""
        given = [episode for episode, is_its in zip(episodes, is_given, strict=True) if is_its]
        infos: dict[str, Any] = {}
        for key in self.info_keys:
            of, dtype = INFO[key]
            values = np.array([of(episode) for episode in given], dtype=dtype)
            # Gymnasium keeps strings in arrays of objects.
            infos[key] = values = values.astype(object) if values.dtype.kind == "U" else values
            if len(given) < len(episodes):
                missing = None if values.dtype == object else 0
                infos[key] = np.full((len(episodes), *values.shape[1:]), missing, dtype=values.dtype)
                infos[key][is_given] = values
            infos[f"_{key}"] = is_given.copy()
        return infos

    def _volume_names(self, options: Any) -> list[str | None]:
        """Return the name of the volume that options choose for each environment; None: drawn at random."""
        listed_names = options.get("volume") if isinstance(options, dict) else None
        if not isinstance(listed_names, list | tuple):
            return [wanted_volume(self.rules, options)] * self.num_envs
        if len(listed_names) != self.num_envs:
            raise InvalidValueError(
                f"reset option 'volume' is {listed_names!r}, but it must be one name, or one for each of "
                f"{self.num_envs} environments"
            )
        return [wanted_volume(self.rules, {**options, "volume": name}) for name in listed_names]

    def _checked_ids(self, env_ids: Any) -> EnvIds:
        ids = np.asarray(env_ids)
        if ids.ndim == 1 and ids.dtype.kind in "iu" and len(ids):
            in_order = np.sort(ids)
            if in_order[0] >= 0 and in_order[-1] < self.num_envs and (in_order[1:] > in_order[:-1]).all():
                return ids.astype(np.int64, copy=False)
        raise InvalidValueError(
            f"env_ids is {env_ids!r}, but it must hold one or more different indices, from 0, of the {self.num_envs} "
            "environments"
        )

    def _seeds(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer) and not isinstance(seed, bool):
            first = check_int("seed", seed, at_least=0)
            return [first + i for i in range(self.num_envs)]
        if not isinstance(seed, list | tuple) or len(seed) != self.num_envs:
            raise InvalidValueError(
                f"seed is {seed!r}, but it must be a whole number, or a list with one for each of {self.num_envs}"
            )
        return [None if one is None else check_int("each of seed", one, at_least=0) for one in seed]

    def _popped_mask(self, options: Any) -> Mask:
        if not isinstance(options, dict) or "reset_mask" not in options:
            return np.ones(self.num_envs, dtype=np.bool_)
        mask = options.pop("reset_mask")
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (self.num_envs,):
            raise InvalidValueError(
                f"reset option 'reset_mask' is {mask!r}, but it must be an array of {self.num_envs} truth values"
            )
        if not mask.any():
            raise InvalidValueError("reset option 'reset_mask' marks no environment, but it must mark at least one")
        return mask


def reset_each(
    envs: VectorEnv[Any, Any, Any],
    seeds: int | Sequence[int | None] | None = None,
    options: dict[str, Any] | None = None,
) -> tuple[Observed, dict[str, Any]]:
    """Reset a vector environment; `seeds` may be a list with one for each environment."""
    # Gymnasium's vector environments accept such lists, although its types do not.
    return envs.reset(seed=seeds, options=options)  # type: ignore[arg-type]


def step_each(envs: VectorEnv[Any, Any, Any], actions: Any, env_ids: Sequence[int] | EnvIds | None) -> VectorStep:
    """Take a step in a vector environment, or, if it is armscan's, in its `env_ids`; see `ArmscanVectorEnv.step`."""
    stepped: VectorStep = envs.step(actions) if env_ids is None else cast(Any, envs).step(actions, env_ids)
    return stepped


def _checked_mode(mode: str | AutoresetMode) -> AutoresetMode:
    for known in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
        if isinstance(mode, str | AutoresetMode) and mode in (known, known.value):
            return known
    raise InvalidValueError(f"autoreset_mode is {mode!r}, but it must be NextStep or Disabled")
