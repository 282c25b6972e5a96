"""The replay buffer of images returns what a plain one returns, and keeps no frame that it does not need."""

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tianshou.data import Batch

from armscan.agents.frame_store import FrameStore, decode, encode
from armscan.agents.image_replay import ImageReplay, replay_for
from armscan.agents.replay import Replay
from armscan.envs import EnvFactory
from armscan.training import load_checkpoint, save_checkpoint
from tests.support.tensors import assert_same_tensors

N_ENVS = 3
RULES = {
    "stacked_channels": {"observation": "slice_channels", "stack": 4, "memory": 2},
    "channels": {"observation": "slice_channels"},
    "labels": {"observation": "slice", "memory": 2},
    "both_one_of_them_stacked": {
        "observation": ["slice", "slice_channels"],
        "stack": 3,
        "stack_exclude": ["channels"],
    },
}


@pytest.fixture(params=list(RULES))
def envs(request, phantom):
    rules = RULES[request.param] | {"max_steps": 4, "projection": "zy"}
    return EnvFactory(**rules).make_vector_env(N_ENVS, [phantom])


def played(envs, n_steps, seed=0):
    """Yield the transitions of all environments, one batch per step; episodes end after four steps at the latest."""
    envs.action_space.seed(seed)
    observations, _ = envs.reset(seed=seed)
    for _ in range(n_steps):
        actions = envs.action_space.sample()
        following, rewards, terminated, truncated, _ = envs.step(actions)
        yield Batch(
            obs=Batch(observations),
            act=actions,
            rew=rewards,
            terminated=terminated,
            truncated=truncated,
            obs_next=Batch(following),
            info=Batch(),
        )
        observations, ended = following, terminated | truncated
        if ended.any():
            observations, _ = envs.reset(options={"reset_mask": ended})


def assert_same(one, other):
    assert set(one.get_keys()) == set(other.get_keys())
    for name in one.get_keys():
        if isinstance(one[name], Batch):
            assert_same(one[name], other[name])
        else:
            assert one[name].dtype == other[name].dtype
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def assert_gives_the_same(image, plain):
    """Check every way to read transitions."""
    assert len(image) == len(plain)
    everything = plain.sample_indices(0)
    assert_same(plain[everything], image[everything])
    assert_same(plain[int(everything[-1])], image[int(everything[-1])])
    for replay in (image, plain):
        replay.seed(len(plain))
    (batch, indices), (other, other_indices) = plain.sample(9), image.sample(9)
    np.testing.assert_array_equal(indices, other_indices)
    assert_same(batch, other)
    assert_same(plain[indices].obs_next, image[indices].obs_next)


def assert_frames_are_those_referred_to(replay):
    for name, images in replay._images.items():
        ids = np.concatenate([replay._meta[key][name].ravel() for key in ("obs", "obs_next")])
        counted = dict(zip(*np.unique(ids[ids != 0], return_counts=True), strict=True))
        references = {i: n for i, n in enumerate(images.frames._n_references) if n}
        assert references == counted
        assert len(images.frames) == len(counted)


@pytest.mark.parametrize("size", [N_ENVS, 4 * N_ENVS, 300])
def test_replay_gives_what_a_plain_one_gives(envs, size):
    plain, image = Replay(size, N_ENVS), replay_for(envs.single_observation_space, size, N_ENVS)
    assert isinstance(image, ImageReplay)
    for i, batch in enumerate(played(envs, 22)):
        for a, b in zip(plain.add(batch), image.add(batch), strict=True):
            np.testing.assert_array_equal(a, b)
        assert_frames_are_those_referred_to(image)
        if i in (0, 3, 12, 21):
            assert_gives_the_same(image, plain)
        if i == 9:
            for replay in (plain, image):
                replay.cut_off()


def test_replay_takes_some_of_the_environments(envs):
    plain, image = Replay(12, N_ENVS), replay_for(envs.single_observation_space, 12, N_ENVS)
    for i, batch in enumerate(played(envs, 15)):
        chosen = np.flatnonzero([True, i % 2 == 0, i % 3 != 0])
        for replay in (plain, image):
            replay.add(batch[chosen], buffer_ids=chosen)
        assert_frames_are_those_referred_to(image)
    assert_gives_the_same(image, plain)


def test_no_frame_is_kept_twice_within_an_episode(phantom):
    envs = EnvFactory(
        observation="slice", projection="zy", stack=4, success_threshold=1e-9, max_steps=50
    ).make_vector_env(1, [phantom])
    replay = replay_for(envs.single_observation_space, 100, 1)
    for batch in played(envs, 30):
        replay.add(batch)
    # The first frame, and one per step.
    assert len(replay._images["slice"].frames) <= 31


def noise(rng):
    """Return transitions of two environments whose frames are unrelated."""
    obs, obs_next = (
        Batch(noise=rng.integers(0, 256, (2, 2, 5, 7), dtype=np.uint8), number=rng.random((2, 1))) for _ in range(2)
    )
    return Batch(
        obs=obs,
        act=rng.random((2, 1)),
        rew=rng.random(2),
        terminated=rng.random(2) < 0.3,
        truncated=np.zeros(2, dtype=bool),
        obs_next=obs_next,
    )


NOISE = {"noise": spaces.Box(0, 255, (2, 5, 7), np.uint8)}


def test_noise_and_unrelated_frames_are_kept_as_they_are():
    rng = np.random.default_rng(0)
    plain, image = Replay(8, 2), ImageReplay(8, 2, NOISE)
    for _ in range(20):
        batch = noise(rng)
        for replay in (plain, image):
            replay.add(batch)
        assert_gives_the_same(image, plain)


@pytest.mark.parametrize("n_between", range(1, 7))
def test_what_was_asked_for_before_is_not_given_for_what_came_later(n_between):
    rng = np.random.default_rng(0)
    plain, image = Replay(2, 2), ImageReplay(2, 2, NOISE)
    for _ in range(8):
        # IDs are reused for other frames.
        for batch in [noise(rng) for _ in range(n_between)]:
            for replay in (plain, image):
                replay.add(batch)
        assert_same(plain[np.arange(2)], image[np.arange(2)])


def test_update_decodes_each_image_once(envs, monkeypatch):
    image = replay_for(envs.single_observation_space, 60, N_ENVS)
    for batch in played(envs, 12):
        image.add(batch)
    calls = []
    wanted = FrameStore.decode
    monkeypatch.setattr(FrameStore, "decode", lambda self, ids: calls.append(ids) or wanted(self, ids))
    _, indices = image.sample(9)
    image[indices]
    assert len(calls) == 2 * len(image._images)


def test_reset_forgets_every_frame(envs):
    plain, image = Replay(15, N_ENVS), replay_for(envs.single_observation_space, 15, N_ENVS)
    for seed in (0, 1):
        for batch in played(envs, 8, seed):
            for replay in (plain, image):
                replay.add(batch)
        assert_gives_the_same(image, plain)
        for replay in (plain, image):
            replay.reset()
        assert len(image) == 0
        assert all(len(images.frames) == 0 for images in image._images.values())


@pytest.mark.parametrize("n_steps", [0, 3, 17])
def test_replay_goes_on_from_a_checkpoint_bit_for_bit(envs, tmp_path, n_steps):
    plain, image, other = (
        Replay(18, N_ENVS),
        *(replay_for(envs.single_observation_space, 18, N_ENVS) for _ in range(2)),
    )
    # Its earlier contents must not matter.
    for batch in played(envs, 4, seed=5):
        other.add(batch)
    for batch in played(envs, n_steps):
        for replay in (plain, image):
            replay.add(batch)
    for replay in (plain, image):
        replay.cut_off()
    save_checkpoint(tmp_path / "last.pt", image.state(), {})
    other.load_state(load_checkpoint(tmp_path / "last.pt")[0])
    if n_steps:
        assert_gives_the_same(other, plain)
    for batch in played(envs, 11, seed=1):
        for replay in (plain, image, other):
            replay.add(batch)
        assert_frames_are_those_referred_to(other)
    assert_gives_the_same(other, plain)
    assert_same_tensors(image.state(), other.state())


def test_observations_without_images_have_a_plain_replay():
    vector = spaces.Box(-1, 1, (3,), np.float32)
    assert type(replay_for(vector, 10, 1)) is Replay
    assert type(replay_for(spaces.Dict({"vector": vector}), 10, 1)) is Replay


PIXELS = st.one_of(
    arrays(np.uint8, st.integers(1, 300)),
    arrays(np.uint8, st.integers(1, 3000), elements=st.integers(0, 1), fill=st.just(0)),
    st.lists(st.tuples(st.integers(0, 255), st.integers(1, 70_000)), min_size=1, max_size=5).map(
        lambda runs: np.repeat(*(np.array(column) for column in zip(*runs, strict=True))).astype(np.uint8)
    ),
)


@given(pixels=PIXELS)
def test_runs_bring_back_every_frame(pixels):
    frame = encode(pixels)
    assert len(frame) <= pixels.size
    np.testing.assert_array_equal(decode([frame, frame], pixels.size), [pixels, pixels])


@given(frames=st.lists(st.binary(max_size=40), max_size=5), n_pixels=st.integers(1, 50))
def test_bytes_of_a_damaged_file_are_harmless(frames, n_pixels):
    assert decode(frames, n_pixels).shape == (len(frames), n_pixels)
