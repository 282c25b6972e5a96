"""The environment as others use it: Gymnasium's checker, its registry and wrappers, another training library."""

import gc
import itertools
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.wrappers import FlattenObservation, NormalizeReward, RecordEpisodeStatistics, RecordVideo, TimeLimit
from gymnasium.wrappers.vector import RecordEpisodeStatistics as VectorRecordEpisodeStatistics

import armscan
from armscan.envs import ClusterObservation, MetricSliceObservation, SliceChannelsObservation, SliceObservation

ENV_IDS = [env_id for env_id in gym.registry if env_id.startswith("armscan/")]
CROP, SHAPE = (201, 70), (24, 20)
OBSERVATIONS = {
    "action_reward": "action_reward",
    "cluster": "cluster",
    "cluster_raw": ClusterObservation(normalised=False),
    "slice": "slice",
    "slice_cropped": SliceObservation(crop=CROP),
    "slice_reduced": SliceObservation(shape=SHAPE),
    "channels": "slice_channels",
    "channels_cropped": SliceChannelsObservation(crop=CROP),
    "channels_reduced": SliceChannelsObservation(crop=CROP, shape=SHAPE),
    "metric": MetricSliceObservation(field_of_view_mm=(97.2, 44.0), pixel_mm=(4.05, 2.2)),
    "merged_vectors": ["action_reward", "cluster"],
    "merged_with_image": ["cluster", SliceObservation(crop=CROP, shape=SHAPE)],
    "merged_images": [SliceChannelsObservation(shape=SHAPE), "slice", ClusterObservation(normalised=False)],
}
PROJECTIONS = ["x", "y", "xy", "zy", "full", ["rz", "tx"]]
STACKS = {"one": {}, "stack": {"stack": 3}}
MEMORIES = {"none": {}, "memory": {"memory": 2}, "memory_first": {"memory": 2, "stack_memory": True}}
FORMS = {"flat": {"flat": True}, "dict": {"flat": False}, "dict_part": {"flat": False, "stack_exclude": ["action"]}}
# A few combinations, for tests that do not need all of them.
MIXED = {
    "vector": {},
    "remembering": {"projection": "zy", "stack": 3, "memory": 2, "stack_memory": True},
    "image": {"observation": ["cluster", SliceChannelsObservation(shape=SHAPE)], "projection": "full"},
    "on_budget": {"ends": "on_budget", "projection": "full"},
    "on_stop": {"ends": "on_stop", "projection": "zy", "stack": 2, "memory": 2, "start": "random"},
    "images": {
        "observation": "slice",
        "stack": 2,
        "stack_exclude": ["reward"],
        "memory": 2,
        "render_mode": "rgb_array",
    },
}


class Presented(gym.Env):
    """Presents an environment and its wrappers as a bare one, because Gymnasium's checker warns of wrappers."""

    def __init__(self, env):
        self.env = env
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.metadata, self.render_mode, self.spec = env.metadata, env.render_mode, env.spec

    @property
    def _np_random(self):
        return self.env.unwrapped._np_random

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        return self.env.step(action)

    def render(self):
        return self.env.render()

    def close(self):
        self.env.close()


@pytest.fixture(scope="module")
def nothing_left_open():
    """Collect what tests of other modules have left open, whose warnings would otherwise be raised during these."""
    gc.collect()


@pytest.fixture(autouse=True)
def no_warnings(nothing_left_open):
    """Turn every warning into an error, Gymnasium's own included."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def play(env, n_steps=4):
    """Return everything that a few steps return."""
    env.action_space.seed(3)
    shown = [env.reset(seed=3)]
    for _ in range(n_steps):
        shown.append(env.step(env.action_space.sample()))
        assert env.observation_space.contains(shown[-1][0])
        if shown[-1][2] or shown[-1][3]:
            shown.append(env.reset())
    return shown


# An excluded part of a stack requires a stack.
LAYOUTS = [(form, stack) for form in FORMS for stack in STACKS if (form, stack) != ("dict_part", "one")]
CHOICES = (list(OBSERVATIONS), PROJECTIONS, LAYOUTS, list(MEMORIES))
# A covering array: of any two choices, every pair of values is in one of its 78 rows.
COVERING = [
    (observation, projection, LAYOUTS[(i + j) % len(LAYOUTS)], CHOICES[3][(i + 2 * j) % len(MEMORIES)])
    for (i, observation), (j, projection) in itertools.product(enumerate(OBSERVATIONS), enumerate(PROJECTIONS))
]


@pytest.mark.parametrize(("first", "second"), list(itertools.combinations(range(len(CHOICES)), 2)))
def test_every_pair_of_choices_is_covered(first, second):
    pairs = [(row[first], row[second]) for row in COVERING]
    assert all(pair in pairs for pair in itertools.product(CHOICES[first], CHOICES[second]))


@pytest.mark.parametrize(("observation", "projection", "layout", "memory"), COVERING, ids=str)
@pytest.mark.parametrize("env_id", ENV_IDS)
def test_env_conforms(wrist, env_id, observation, projection, layout, memory):
    """The checker finds nothing; pickled, or made again from its spec, the environment plays the same episodes."""
    form, stack = layout
    rules = {"observation": OBSERVATIONS[observation], "projection": projection, "max_steps": 3}
    env = gym.make(env_id, volumes=[wrist], **rules, **FORMS[form], **STACKS[stack], **MEMORIES[memory])
    assert isinstance(env.observation_space, gym.spaces.Box if form == "flat" else gym.spaces.Dict)
    check_env(Presented(env), skip_render_check=True)
    shown = play(env)
    pickled = pickle.loads(pickle.dumps(env))
    assert data_equivalence(play(pickled), shown, exact=True)
    assert data_equivalence(play(gym.make(pickled.spec)), shown, exact=True)


def make_mixed(wrist, variant, **changes):
    return gym.make(armscan.ENV_ID, **{"volumes": [wrist], "max_steps": 3} | MIXED[variant] | changes)


@pytest.mark.parametrize("variant", ["on_budget", "on_stop"])
def test_env_conforms_where_the_last_plane_is_tested(wrist, variant):
    env = make_mixed(wrist, variant)
    check_env(Presented(env), skip_render_check=True)
    assert data_equivalence(play(pickle.loads(pickle.dumps(env))), play(env), exact=True)


def test_env_conforms_where_it_is_rendered(wrist, unseen_windows):
    """Check pictures as the checker does; this check costs too much to run over every combination."""
    check_env(Presented(make_mixed(wrist, "images", render_mode="rgb_array")))
    check_env(gym.make(armscan.ENV_ID, volumes=[wrist], render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize(("variant", "kind"), [("vector", gym.spaces.Box), ("images", gym.spaces.Dict)])
def test_env_is_flat_by_itself_where_every_part_is_a_vector(wrist, variant, kind):
    assert isinstance(make_mixed(wrist, variant).observation_space, kind)


@pytest.mark.parametrize("excluded", [{}, {"stack_exclude": ["action"]}], ids=["none excluded", "action excluded"])
def test_spec_round_trip_through_text(data_folder, excluded):
    """A spec can be text if its arguments can: a folder rather than volumes, names rather than objects."""
    rules = {"observation": ["cluster", "slice"], "stack": 2, "memory": 1, "max_steps": 3}
    env = gym.make(armscan.ENV_ID, volumes=str(data_folder), **rules, **excluded)
    spec = gym.envs.registration.EnvSpec.from_json(env.spec.to_json())
    assert spec == env.spec
    assert data_equivalence(play(gym.make(spec)), play(env), exact=True)


def test_seeds_are_the_environments_own(wrist):
    """An episode depends on its seed alone: not on the global generators, nor on environments played between."""
    env, other = (make_mixed(wrist, "vector", start="random") for _ in range(2))
    shown = play(env)
    np.random.seed(0)  # noqa: NPY002 - the global one is meant
    play(other)
    assert data_equivalence(play(env), shown, exact=True)
    assert not data_equivalence(env.reset(seed=4)[0], shown[0][0])


@pytest.mark.parametrize("variant", MIXED)
def test_gymnasiums_wrappers_work_on_it(wrist, variant):
    env = NormalizeReward(RecordEpisodeStatistics(FlattenObservation(TimeLimit(make_mixed(wrist, variant), 2))))
    bare = make_mixed(wrist, variant)
    env.action_space.seed(0)
    for episode in range(3):
        observed, _ = env.reset(seed=episode)
        expected, _ = bare.reset(seed=episode)
        rewards, is_over = [], False
        while not is_over:
            np.testing.assert_array_equal(observed, gym.spaces.flatten(bare.observation_space, expected))
            assert env.observation_space.contains(observed)
            action = env.action_space.sample()
            observed, normalised, terminated, truncated, info = env.step(action)
            expected, reward, *_ = bare.step(action)
            assert np.isfinite(normalised)
            rewards.append(reward)
            is_over = terminated or truncated
        assert len(rewards) <= 2
        # `TimeLimit` truncates at its last step, even if that step has ended the episode.
        assert truncated == (len(rewards) == 2)
        assert info["episode"]["l"] == len(rewards)
        assert info["episode"]["r"] == pytest.approx(sum(rewards))


@pytest.mark.parametrize("variant", ["remembering", "images"])
def test_gymnasium_records_a_video_of_it(wrist, variant, tmp_path):
    with warnings.catch_warnings():
        # Warnings of MoviePy, which writes the video, are not ours.
        warnings.filterwarnings("default", module="moviepy")
        env = RecordVideo(make_mixed(wrist, variant, render_mode="rgb_array"), str(tmp_path / "video"), lambda _: True)
        env.reset(seed=0)
        for _ in range(2):
            env.step(np.full(env.action_space.shape, -1.0))
        assert [frame.shape for frame in env.recorded_frames] == [(512, 860, 3)] * 3
        env.close()
    assert [path.stat().st_size > 1000 for path in tmp_path.glob("video/*.mp4")] == [True]


@pytest.mark.parametrize("variant", ["vector", "remembering", "image", "on_budget", "on_stop"])
@pytest.mark.parametrize("env_id", ENV_IDS)
def test_vector_env_conforms(wrist, env_id, variant):
    """Spaces and shapes; test_vector_env.py compares the results with those of single environments."""
    arguments = {"volumes": [wrist], "max_steps": 3} | MIXED[variant]
    envs, single = gym.make_vec(env_id, num_envs=2, **arguments), gym.make(env_id, **arguments)
    assert envs.single_observation_space == single.observation_space
    assert envs.single_action_space == single.action_space
    assert envs.observation_space == gym.vector.utils.batch_space(single.observation_space, 2)
    envs = VectorRecordEpisodeStatistics(envs)
    envs.action_space.seed(0)
    observed, _ = envs.reset(seed=0)
    lengths = []
    for _ in range(9):
        assert envs.observation_space.contains(observed)
        observed, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
        assert rewards.shape == terminated.shape == truncated.shape == (2,)
        assert terminated.dtype == truncated.dtype == bool
        if (terminated | truncated).any():
            lengths += infos["episode"]["l"][infos["_episode"]].tolist()
    assert len(lengths) >= 4
    assert set(lengths) <= {1, 2, 3}
    envs.close()


@pytest.fixture
def learn():
    """Yield a function that trains with Stable-Baselines3, checks that weights have changed, and returns the model."""
    with warnings.catch_warnings():
        # Warnings about its own defaults, such as the image size that its convolutions expect, are not ours.
        warnings.simplefilter("ignore")
        import stable_baselines3 as baselines
        from stable_baselines3.common.env_checker import check_env as check_for_baselines

        def run(algorithm, policy, env, **settings):
            check_for_baselines(env)
            model = getattr(baselines, algorithm)(
                policy, env, seed=0, device="cpu", policy_kwargs={"net_arch": [16, 16]}, batch_size=32, **settings
            )
            # The default logger leaves an empty folder in the temporary one.
            model.set_logger(baselines.common.logger.Logger(folder=None, output_formats=[]))
            before = [weight.detach().clone() for weight in model.policy.parameters()]
            model.learn(300)
            changed = [
                (weight != old).any().item() for weight, old in zip(model.policy.parameters(), before, strict=True)
            ]
            assert any(changed)
            assert all(weight.isfinite().all() for weight in model.policy.parameters())
            return model

        yield run


@pytest.mark.parametrize(
    ("algorithm", "policy", "variant", "settings"),
    [
        ("SAC", "MlpPolicy", "remembering", {"learning_starts": 50, "buffer_size": 300, "train_freq": 4}),
        ("PPO", "MlpPolicy", "vector", {"n_steps": 64, "n_epochs": 2}),
        ("PPO", "MultiInputPolicy", "image", {"n_steps": 64, "n_epochs": 2}),
    ],
)
def test_stable_baselines_trains_on_it(wrist, learn, algorithm, policy, variant, settings):
    env = make_mixed(wrist, variant)
    model = learn(algorithm, policy, env, **settings)
    for seed in range(5):
        action, _ = model.predict(env.reset(seed=seed)[0], deterministic=True)
        assert env.action_space.contains(action)
