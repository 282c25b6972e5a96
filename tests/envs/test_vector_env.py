"""Many environments at once give what each alone gives."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from torch.utils.data import DataLoader, Dataset

import armscan
from armscan.envs import ArmscanVectorEnv, RandomTransform
from armscan.envs.history import rows_of
from armscan.errors import InvalidValueError, ResetNeededError
from armscan.volumes import LabelVolume

VARIANTS = [
    {},
    {"projection": "zy", "stack": 3, "memory": 2},
    {"projection": "zy", "stack": 2, "memory": 2, "stack_memory": True, "start": "random"},
    {"observation": "slice_channels", "projection": "full", "stack": 2, "stack_exclude": ["action"], "memory": 2},
    {"observation": ["cluster", "slice"], "projection": ["rz", "tx"], "memory": 1},
    {"ends": "on_budget", "projection": "full"},
    {"ends": "on_stop", "projection": "zy", "stack": 2, "memory": 2, "start": "random", "observation": "slice_metric"},
    {"projection": "full", "transform": RandomTransform(rx_deg=5.0, scale=0.1, stretch=0.1, shear=0.1, mirror=True)},
    {"clustering": "metric", "observation": "action_reward", "transform": None},
]


def assert_same(ours, theirs):
    assert type(ours) is type(theirs)
    if isinstance(ours, dict):
        assert ours.keys() == theirs.keys()
        for key in ours:
            assert_same(ours[key], theirs[key])
    elif isinstance(ours, tuple):
        assert len(ours) == len(theirs)
        for our, their in zip(ours, theirs, strict=True):
            assert_same(our, their)
    elif isinstance(ours, np.ndarray):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)
    else:
        assert ours == theirs


@pytest.fixture(scope="module")
def volumes(dataset):
    """Two volumes whose slices have different shapes."""
    first, second = list(dataset.values())[:2]
    return [first, LabelVolume(second.labels[10:-3], second.spacing, "narrow", second.optimal_action)]


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_vector_env_gives_bit_for_bit_what_single_environments_give(volumes, variant):
    """The reference is Gymnasium's own vector environment of single ones: same seeds and actions, several episodes."""
    arguments = {"volumes": volumes, "max_steps": 4} | variant
    ours = gym.make_vec(armscan.ENV_ID, num_envs=3, **arguments)
    theirs = SyncVectorEnv([lambda: gym.make(armscan.ENV_ID, **arguments)] * 3)
    assert isinstance(ours.unwrapped, ArmscanVectorEnv)
    assert ours.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP is theirs.metadata["autoreset_mode"]
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert_same(ours.reset(seed=7), theirs.reset(seed=7))
    assert ours.unwrapped.np_random_seed == theirs.np_random_seed == (7, 8, 9)
    ours.action_space.seed(0)
    n_ended = 0
    for _ in range(14):
        actions = ours.action_space.sample()
        step = ours.step(actions)
        assert_same(step, theirs.step(actions))
        assert ours.observation_space.contains(step[0])
        n_ended += (step[2] | step[3]).sum()
    assert n_ended > 3


def test_vector_env_resets_only_those_that_are_marked(phantom):
    arguments = {"volumes": [phantom], "projection": "zy", "max_steps": 3, "stack": 3, "memory": 2}
    ours = gym.make_vec(armscan.ENV_ID, num_envs=3, autoreset_mode="Disabled", **arguments)
    theirs = SyncVectorEnv([lambda: gym.make(armscan.ENV_ID, **arguments)] * 3, autoreset_mode=AutoresetMode.DISABLED)
    assert_same(ours.reset(seed=[4, 5, 9]), theirs.reset(seed=[4, 5, 9]))
    ours.action_space.seed(1)
    for _ in range(12):
        actions = ours.action_space.sample()
        step = ours.step(actions)
        assert_same(step, theirs.step(actions))
        ended = step[2] | step[3]
        if ended.any():
            assert_same(ours.reset(options={"reset_mask": ended}), theirs.reset(options={"reset_mask": ended.copy()}))
    marked = np.array([True, False, True])
    assert_same(ours.reset(options={"reset_mask": marked}), theirs.reset(options={"reset_mask": marked.copy()}))


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_vector_env_takes_steps_in_some_environments_only(volumes, variant):
    """Each environment steps at its own pace, and gives what it gives alone."""
    arguments = {"volumes": volumes, "max_steps": 4} | variant
    together = gym.make_vec(armscan.ENV_ID, num_envs=4, autoreset_mode="Disabled", **arguments)
    alone = [gym.make(armscan.ENV_ID, **arguments) for _ in range(4)]
    observed, _ = together.reset(seed=[5, 6, 7, 8])
    for i, env in enumerate(alone):
        assert_same(rows_of(observed, i), env.reset(seed=5 + i)[0])
    running, rng = [True] * 4, np.random.default_rng(0)
    while any(running):
        chosen = rng.permutation([i for i in range(4) if running[i] and rng.random() < 0.7])
        if not len(chosen):
            continue
        actions = rng.uniform(-1, 1, (len(chosen), *alone[0].action_space.shape)).astype(np.float32)
        observed, rewards, terminated, truncated, infos = together.step(actions, env_ids=chosen)
        for row, i in enumerate(chosen):
            theirs = alone[i].step(actions[row])
            assert_same(rows_of(observed, row), theirs[0])
            assert (rewards[row], terminated[row], truncated[row]) == theirs[1:4]
            assert infos["distance_mm"][row] == theirs[4]["distance_mm"]
            running[i] = not (terminated[row] or truncated[row])


def test_vector_env_takes_a_volume_for_all_or_one_for_each(dataset):
    envs, names = ArmscanVectorEnv(3, dataset), list(dataset)
    assert envs.reset(seed=0, options={"volume": names[2]})[1]["volume"].tolist() == [names[2]] * 3
    chosen = [names[2], names[0], names[2]]
    assert envs.reset(seed=0, options={"volume": chosen})[1]["volume"].tolist() == chosen
    for wrong in (names[:2], [*names[:2], "nope"], [*names[:2], 3]):
        with pytest.raises(InvalidValueError, match="reset option 'volume' is"):
            envs.reset(options={"volume": wrong})


def test_vector_env_shares_the_rules_of_others(dataset):
    rules = ArmscanVectorEnv(1, dataset, projection="zy").rules
    envs, twins = ArmscanVectorEnv.sharing(rules, 3), ArmscanVectorEnv(3, dataset, projection="zy")
    assert envs.rules is rules
    assert envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    assert envs.observation_space == twins.observation_space
    assert_same(envs.reset(seed=4), twins.reset(seed=4))


def test_vector_env_refuses_what_is_impossible(phantom):
    with pytest.raises(InvalidValueError, match="num_envs is 0"):
        ArmscanVectorEnv(0, [phantom])
    with pytest.raises(InvalidValueError, match="autoreset_mode is 'SameStep', but it must be NextStep or Disabled"):
        ArmscanVectorEnv(2, [phantom], autoreset_mode="SameStep")
    with pytest.raises(InvalidValueError, match="render_mode is 'human'"):
        ArmscanVectorEnv(2, [phantom], render_mode="human")
    envs = ArmscanVectorEnv(2, [phantom], autoreset_mode="Disabled", max_steps=1)
    with pytest.raises(ResetNeededError, match="environment 0 has no episode yet"):
        envs.step(np.zeros((2, 1)))
    for options in ({"reset_mask": [True, False]}, {"reset_mask": np.array([True])}, {"reset_mask": np.zeros(2, bool)}):
        with pytest.raises(InvalidValueError, match="'reset_mask'"):
            envs.reset(options=options)
    for seed in ([1], "ab c", 1.5):
        with pytest.raises(InvalidValueError, match="seed is"):
            envs.reset(seed=seed)
    envs.reset(seed=0)
    for actions in (np.zeros(2), np.full((2, 1), np.nan), "up", None):
        with pytest.raises(InvalidValueError, match=r"(?s)action is .*\(2, 1\)"):
            envs.step(actions)
    for env_ids in ([], [0, 0], [2], [-1], [0.0], [[0]], "0", [True, False]):
        with pytest.raises(InvalidValueError, match=r"env_ids is .* of the 2 environments"):
            envs.step(np.zeros((len(env_ids), 1)), env_ids=env_ids)
    with pytest.raises(InvalidValueError, match=r"(?s)action is .*\(1, 1\)"):
        envs.step(np.zeros((2, 1)), env_ids=[1])
    envs.step(np.full((2, 1), -1.0))
    with pytest.raises(ResetNeededError, match=r"environments \[0, 1\] have ended"):
        envs.step(np.zeros((2, 1)))


def test_vector_env_that_refuses_a_reset_changes_nothing(phantom):
    envs, twins = (ArmscanVectorEnv(2, [phantom], start="random") for _ in range(2))
    for each in (envs, twins):
        each.reset(seed=3)
    for seed, options in ((9, {"volume": "nope"}), (-1, None), ([1, -2], None), ([1, "a"], None), (True, None)):
        with pytest.raises(InvalidValueError):
            envs.reset(seed=seed, options=options)
    np.testing.assert_array_equal(envs.reset()[0], twins.reset()[0])


def test_vector_env_gives_every_key_of_info_a_mask_of_its_own(phantom):
    envs = ArmscanVectorEnv(2, [phantom])
    infos = envs.reset(seed=0)[1]
    masks = [part for key, part in infos.items() if key.startswith("_")]
    assert len(masks) == len(infos) / 2
    assert not any(np.shares_memory(*pair) for pair in itertools.combinations(masks, 2))


def test_forks_of_a_process_that_has_looked_at_many_planes_go_on(volumes, monkeypatch):
    """As Gymnasium's AsyncVectorEnv and PyTorch's DataLoader fork."""
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    here = ArmscanVectorEnv(num_envs=4, volumes=volumes)
    seen, _ = here.reset(seed=0)

    def make():
        return Pair(volumes)

    forks = AsyncVectorEnv([make, make], context="fork")
    try:
        for forked in forks.reset(seed=0)[0]:
            np.testing.assert_array_equal(forked, seen[:2])
        forks.step(forks.action_space.sample())
    finally:
        forks.close()
    loaded = DataLoader(Looks(volumes), batch_size=None, num_workers=2, multiprocessing_context="fork")
    for each in loaded:
        np.testing.assert_array_equal(each, seen[:2])
    np.testing.assert_array_equal(here.reset(seed=0)[0], seen)


class Pair(gym.Env):
    """Two environments at once, as one."""

    def __init__(self, volumes):
        self._envs = ArmscanVectorEnv(num_envs=2, volumes=volumes)
        self.observation_space, self.action_space = self._envs.observation_space, self._envs.action_space

    def reset(self, *, seed=None, options=None):
        return self._envs.reset(seed=0)[0], {}

    def step(self, action):
        observations, rewards, *_ = self._envs.step(action)
        return observations, float(rewards.sum()), False, False, {}


class Looks(Dataset):
    """Return the first observations of two environments."""

    def __init__(self, volumes):
        self._volumes = volumes

    def __len__(self):
        return 4

    def __getitem__(self, number):
        return ArmscanVectorEnv(num_envs=2, volumes=self._volumes).reset(seed=0)[0]
