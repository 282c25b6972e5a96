"""The environment, as Gymnasium and as its own page describe it."""

import copy
import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import armscan
from armscan.anatomy import METRIC_TISSUES, AgreementReward, LandmarkReward, Scanner, TissueClusters, landmark_reward
from armscan.envs import ArmscanEnv, ClusterObservation, ManipulatorAction
from armscan.errors import InvalidValueError, ManifestError, OptimalPlaneError, ResetNeededError, VolumeError
from armscan.volumes import LabelVolume
from tests.support.programs import output_of


@pytest.fixture
def env(phantom):
    return ArmscanEnv([phantom])


def test_make_without_arguments_gives_phantoms():
    env = gym.make(armscan.ENV_ID)
    observed, info = env.reset(seed=0)
    assert env.observation_space.contains(observed)
    assert info["volume"].startswith("phantom-")


def test_env_reads_the_volumes_of_a_folder(data_folder):
    env = ArmscanEnv(data_folder)
    assert list(env.volumes) == [f"0000{number}_labels.nii.gz" for number in (1, 2, 3, 4)]


def play(env, seed, n_steps=30):
    """Return everything that an episode or two show, with actions from the environment's own generator."""
    env.action_space.seed(seed)
    observed, info = env.reset(seed=seed)
    trace = [observed.tolist(), info["volume"], info["translation_mm"].tolist()]
    for _ in range(n_steps):
        observed, reward, terminated, truncated, info = env.step(env.action_space.sample())
        trace += [observed.tolist(), reward, terminated, truncated, info["distance_mm"], info["distance_deg"]]
        if terminated or truncated:
            observed, info = env.reset()
            trace += [observed.tolist(), info["volume"]]
    return trace


def test_env_with_the_same_seed_plays_the_same_episode(dataset, env):
    first, second = (ArmscanEnv(dataset, projection="zy", start="random") for _ in range(2))
    assert play(first, 5) == play(second, 5)
    assert play(first, 5) != play(first, 6)


def test_env_with_the_same_seed_plays_the_same_episode_in_another_process(env):
    script = (
        "import json, sys; from armscan.envs import ArmscanEnv; from armscan.volumes import load_phantom\n"
        "from tests.envs.test_env import play\n"
        "print(json.dumps(play(ArmscanEnv([load_phantom(0)]), 5, 5), default=bool))"
    )
    assert json.loads(output_of(script)) == json.loads(json.dumps(play(env, 5, 5), default=bool))


def test_env_terminates_above_minus_delta_at_the_optimum(phantom):
    env = ArmscanEnv([phantom], projection="full")
    env.reset(seed=0)
    _, reward, terminated, truncated, info = env.step(env.scene.optimum_normalised)
    assert (reward > -0.05, terminated, truncated, info["is_success"]) == (True, True, False, True)
    assert (info["distance_mm"], info["distance_deg"]) == pytest.approx((0.0, 0.0), abs=1e-4)


@pytest.mark.parametrize("max_steps", [1, 3])
def test_env_truncates_at_exactly_max_steps(phantom, max_steps):
    env = ArmscanEnv([phantom], max_steps=max_steps)
    env.reset(seed=0)
    ends = [env.step(np.array([-1.0]))[2:4] for _ in range(max_steps)]
    assert ends == [(False, False)] * (max_steps - 1) + [(False, True)]


def test_env_does_not_truncate_a_success_on_the_last_step(phantom):
    env = ArmscanEnv([phantom], max_steps=1)
    env.reset(seed=0)
    assert env.step(env.scene.optimum_normalised[3:])[2:4] == (True, False)


def test_env_on_budget_goes_on_after_a_rewarded_plane_and_judges_the_last(phantom):
    env = ArmscanEnv([phantom], projection="full", ends="on_budget", max_steps=3)
    for last_is_optimal in (True, False):
        env.reset(seed=0)
        optimum, beside = env.scene.optimum_normalised, np.full(4, -1.0)
        planes = [optimum, beside, optimum] if last_is_optimal else [beside, optimum, beside]
        steps = [env.step(plane) for plane in planes]
        assert [step[2:4] for step in steps] == [(False, False), (False, False), (False, True)]
        assert [step[4]["is_success"] for step in steps] == [plane is optimum for plane in planes]
        with pytest.raises(ResetNeededError):
            env.step(optimum)


def test_env_on_stop_ends_with_the_plane_at_which_the_agent_stops(phantom):
    env = ArmscanEnv([phantom], projection="full", ends="on_stop", max_steps=3)
    assert env.action_names == ("rz", "rx", "tx", "ty", "stop")
    for stop_at in (0, 1, 2, None):
        _, info = env.reset(seed=0)
        assert info["action"].tolist() == [0.0] * 5
        planes = [np.full(4, -1.0), env.scene.optimum_normalised, np.full(4, 1.0)]
        for n, plane in enumerate(planes):
            _, reward, terminated, truncated, info = env.step(np.append(plane, 0.1 if n == stop_at else 0.0))
            assert (terminated, truncated) == (n == stop_at, n == 2 and stop_at != 2)
            assert info["is_success"] == (reward > -0.05) == (n == 1)
            if terminated:
                break


@pytest.mark.parametrize("start", ["middle", "random"])
def test_env_shows_the_same_however_an_episode_ends(phantom, start):
    """Rewards and observations are the same; only the action may have one more component."""
    rules = {"projection": "zy", "observation": "slice_channels", "start": start}
    shown = {}
    for ends in ("on_reward", "on_budget", "on_stop"):
        env = ArmscanEnv([phantom], ends=ends, **rules)
        observed = [(env.reset(seed=2)[0], 0.0)]
        for plane in ([-0.9, -0.9], [0.8, 0.9]):
            action = [*plane, -1.0] if ends == "on_stop" else plane
            observed.append(env.step(np.array(action))[:2])
        shown[ends] = [
            (each["channels"].tolist(), each["action"][:2].tolist(), each["reward"].tolist(), reward)
            for each, reward in observed
        ]
    assert shown["on_reward"] == shown["on_budget"] == shown["on_stop"]


def test_env_keeps_the_fixed_components_at_the_optimum(phantom):
    env = ArmscanEnv([phantom], projection="y")
    env.reset(seed=3)
    for ty in (-0.7, 0.1):
        env.step(np.array([ty]))
        rotation, (tx, _) = env.plane.rotation, env.plane.translation
        assert rotation == pytest.approx(env.scene.optimum.rotation)
        assert tx == pytest.approx(env.scene.optimum.translation[0])


def test_env_starts_in_the_middle_or_at_random(phantom):
    assert ArmscanEnv([phantom], projection="zy").reset(seed=0)[1]["action"].tolist() == [0, 0]
    starts = [ArmscanEnv([phantom], projection="zy", start="random").reset(seed=s)[1]["action"] for s in range(20)]
    assert np.ptp(starts, axis=0).min() > 1


def test_env_says_when_an_episode_starts_solved(dataset):
    env = ArmscanEnv(dataset)
    solved = []
    for seed in range(40):
        _, info = env.reset(seed=seed)
        assert info["starts_solved"] == info["is_success"]
        solved.append(info["starts_solved"])
        info = env.step(np.array([0.0]))[4]
        assert info["starts_solved"] == solved[-1]
    assert 0 < sum(solved) < 40


def test_env_looks_once_a_step(env, monkeypatch):
    calls = []
    look = Scanner.look
    monkeypatch.setattr(Scanner, "look", lambda *arguments: calls.append(1) or look(*arguments))
    env.reset(seed=0)
    calls.clear()
    env.step(np.array([0.3]))
    assert len(calls) == 1


def test_env_shows_what_it_rewards(phantom):
    env = ArmscanEnv([phantom], transform=None, projection="full")
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.array([0.1, 0.0, -1.0, 0.2]))
    assert info["rotation_deg"].tolist() == pytest.approx([18.0, 0.0])
    np.testing.assert_array_equal(
        env.slice_xz, phantom.slice(ManipulatorAction(info["rotation_deg"], info["translation_mm"]))
    )
    assert info["reward"] == reward


def test_env_clips_actions_and_refuses_impossible_ones(env):
    env.reset(seed=0)
    assert [env.step(np.array([ty]))[4]["action"] for ty in (7.0, -1e300)] == [1.0, -1.0]
    for bad in ([np.nan], [np.inf], [-np.inf], np.zeros(2), 0.5, "x", ["a"], {"a": 1}, None):
        with pytest.raises(InvalidValueError, match=r"action is .*, but it must be an array of shape \(1,\) of finite"):
            env.step(bad)


def test_env_needs_a_reset_before_and_after_an_episode(env):
    with pytest.raises(ResetNeededError, match="reset"):
        env.step(np.array([0.0]))
    with pytest.raises(ResetNeededError, match="reset"):
        _ = env.scene
    with pytest.raises(ResetNeededError, match="reset"):
        _ = env.plane
    with pytest.raises(ResetNeededError, match="reset"):
        _ = env.slice_xz
    env.reset(seed=0)
    env.step(env.scene.optimum_normalised[3:])
    with pytest.raises(ResetNeededError, match="reset"):
        env.step(np.array([0.0]))


def test_reset_takes_the_volume_as_an_option(dataset):
    env = ArmscanEnv(dataset)
    for name in dataset:
        assert env.reset(seed=0, options={"volume": name})[1]["volume"] == name
    with pytest.raises(InvalidValueError, match="reset option 'volume' is 'nobody'"):
        env.reset(options={"volume": "nobody"})
    with pytest.raises(InvalidValueError, match="reset options are 'fast'"):
        env.reset(options="fast")
    with pytest.raises(InvalidValueError, match="reset option is speed"):
        env.reset(options={"speed": 1})


class Unfitted(LandmarkReward):
    def fit(self, volumes, tissues=None):
        pass


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"success_threshold": 0}, "success_threshold is 0"),
        ({"success_threshold": "a"}, "success_threshold is 'a'"),
        ({"ends": "at_last"}, "ends is 'at_last', but it must be on_reward, on_budget or on_stop"),
        ({"max_steps": 0}, "max_steps is 0"),
        ({"max_steps": 2.5}, "max_steps is 2.5"),
        ({"start": "end"}, "start is 'end', but it must be middle or random"),
        ({"targets": (4, 3)}, "targets is"),
        ({"projection": "q"}, "projection is 'q'"),
        ({"observation": "q"}, "observation is 'q'"),
        ({"rotation_bounds_deg": (90,)}, "rotation_bounds_deg is"),
        ({"rotation_bounds_deg": (400, 90)}, "rotation bound of rz"),
        ({"translation_bounds_mm": 5}, "translation_bounds_mm is 5"),
        ({"transform": 3}, "transform is 3"),
        ({"clustering": "mm"}, "clustering is 'mm', but it must be pixels or metric"),
        ({"flat": "yes"}, "flat is 'yes'"),
        ({"reward": "best"}, "reward is 'best'"),
        ({"reward": LandmarkReward}, "reward is <class"),
        ({"reward": Unfitted()}, "Unfitted.fit returned None, but it must return a fitted reward"),
        ({"reward": LandmarkReward(), "targets": (7, 5, 1)}, "only one of them"),
        ({"render_mode": "sound"}, "render_mode is 'sound'"),
        ({"volumes": []}, "volumes is empty"),
        ({"volumes": [1]}, "volumes holds 1"),
        ({"volumes": 3}, "volumes is 3"),
        ({"observation": ClusterObservation}, "observation is <class"),
    ],
)
def test_env_refuses_impossible_arguments(phantom, arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        ArmscanEnv(**({"volumes": [phantom]} | arguments))


def test_env_refuses_two_volumes_of_one_name(phantom):
    with pytest.raises(InvalidValueError, match="two of the same name"):
        ArmscanEnv([phantom, phantom])


def test_env_passes_on_what_is_wrong_with_a_folder(tmp_path, write_labelmap):
    with pytest.raises(VolumeError, match="nowhere"):
        ArmscanEnv(tmp_path / "nowhere")
    write_labelmap()
    with pytest.raises(ManifestError, match=r"optimal_actions\.json"):
        ArmscanEnv(tmp_path)


def test_env_takes_volumes_of_different_spacing_by_metric_clustering(dataset):
    """The same arm in its own pixels and in finer ones: the same plane shows the same tissues for the same reward."""
    volume = list(dataset.values())[1]
    s_x, s_y, s_z = volume.spacing
    finer = LabelVolume(volume.labels.repeat(2, axis=0), (s_x / 2, s_y, s_z), "finer", volume.optimal_action)
    env = ArmscanEnv(
        [volume, finer], clustering="metric", transform=None, projection="zy", rotation_bounds_deg=(90, 45)
    )
    seen = []
    for name in env.volumes:
        env.reset(seed=0, options={"volume": name})
        observed, reward, *_ = env.step(env.scene.optimum_normalised[[0, 3]])
        assert env.observation_space.contains(observed)
        assert reward == 0.0
        seen.append(observed[:12].reshape(3, 4))
    np.testing.assert_array_equal(seen[0][:, 0], seen[1][:, 0])
    np.testing.assert_allclose(seen[0], seen[1], atol=0.12)


class ArteryOnly:
    """A user's own reward: 0 where exactly one artery is seen."""

    def fit(self, volumes, tissues):
        return self

    def score(self, landmarks, pixel_mm):
        return 0.0 if landmarks[2, 0] == 1 else -1.0


def agreement(volume):
    return AgreementReward().fit([volume])


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (AgreementReward(), agreement),
        (LandmarkReward((5, 3, 1)), lambda _: LandmarkReward((5, 3, 1))),
        (LandmarkReward(), lambda _: LandmarkReward()),
        (ArteryOnly(), lambda _: ArteryOnly()),
    ],
    ids=["agreement", "other_targets", "published", "own"],
)
def test_env_takes_rewards_as_objects(wrist, given, expected):
    env = ArmscanEnv([wrist], reward=given, projection="full", max_steps=20)
    expected = expected(wrist)
    env.action_space.seed(0)
    env.reset(seed=0)
    rewards, terminated = [], False
    while not terminated and len(rewards) < 12:
        _, reward, terminated, _, info = env.step(env.action_space.sample())
        rewards.append(reward)
        assert reward == info["reward"] == expected.score(env.episode.view.landmarks, wrist.pixel_mm)
        assert terminated == (reward > -0.05)
    env.reset(seed=0)
    assert env.step(env.scene.optimum_normalised)[2]


def test_env_fits_a_reward_to_its_volumes_and_leaves_the_one_given_as_it_is(wrist):
    given = AgreementReward()
    fitted = ArmscanEnv([wrist], reward=given).rules.reward
    assert isinstance(fitted, AgreementReward)
    with pytest.raises(InvalidValueError, match=r"call fit\("):
        given.score(np.zeros((3, 4)), wrist.pixel_mm)
    assert ArmscanEnv([wrist], reward=fitted).rules.reward is fitted


def test_env_refuses_volumes_that_do_not_show_the_other_published_targets(wrist):
    with pytest.raises(OptimalPlaneError, match=r"wrist: the labelled plane scores -0\.\d+"):
        ArmscanEnv([wrist], targets=(7, 5, 1))
    assert ArmscanEnv([wrist], targets=(7, 5, 1), success_threshold=0.2).reset(seed=0)


@pytest.mark.parametrize("clustering", ["metric", METRIC_TISSUES], ids=["name", "tissues"])
def test_env_clusters_by_millimetres(wrist, clustering):
    env = ArmscanEnv([wrist], clustering=clustering, projection="full")
    env.reset(seed=0)
    info = env.step(env.scene.optimum_normalised)[4]
    view = env.episode.view
    metric = TissueClusters.from_slice(env.slice_xz, METRIC_TISSUES, wrist.pixel_mm)
    np.testing.assert_array_equal(view.landmarks, metric.landmarks)
    assert (view.landmarks != TissueClusters.from_slice(env.slice_xz).landmarks).any()
    assert view.clusters.counts == metric.counts == tuple(info["counts"])
    assert info["reward"] == landmark_reward(metric) > -0.05


class Broken:
    """A user's own reward that returns what no reward may be."""

    def __init__(self, given):
        self.given = given

    def fit(self, volumes, tissues):
        return self

    def score(self, landmarks, pixel_mm):
        return self.given


@pytest.mark.parametrize("given", [5.0, -1.5, float("nan"), None, "best", np.zeros(1)])
def test_env_refuses_what_a_reward_of_ones_own_may_not_give(wrist, given):
    with pytest.raises(InvalidValueError, match="the score of Broken is"):
        ArmscanEnv([wrist], reward=Broken(given))


def test_env_fits_a_reward_with_its_own_clustering(dataset):
    given = AgreementReward(slack=0.0, slack_mm=0.0)
    env = ArmscanEnv(dataset, reward=given, clustering="metric", transform=None, projection="full")
    for name in dataset:
        env.reset(options={"volume": name})
        assert env.step(env.scene.optimum_normalised)[1] == 0.0


def test_make_copies_no_volume(wrist):
    env = gym.make(armscan.ENV_ID, volumes=[wrist], stack=2, memory=1)
    assert env.spec.kwargs["volumes"][0] is wrist
    assert copy.deepcopy(env).unwrapped.volumes["wrist"] is wrist


def test_refused_reset_changes_nothing(wrist):
    env, twin = (ArmscanEnv([wrist], start="random") for _ in range(2))
    for each in (env, twin):
        each.reset(seed=3)
    for seed, options in ((9, {"volume": "nope"}), (-1, None), (1.5, None)):
        with pytest.raises(InvalidValueError):
            env.reset(seed=seed, options=options)
    np.testing.assert_array_equal(env.reset()[0], twin.reset()[0])


def test_env_shows_its_slice_but_does_not_hand_it_out(wrist):
    env = ArmscanEnv([wrist])
    env.reset(seed=0)
    with pytest.raises(ValueError, match="read-only"):
        env.slice_xz[0, 0] = 1


def test_env_takes_volumes_only_under_their_names(wrist):
    with pytest.raises(InvalidValueError, match="volumes holds 'wrist' as 'a'"):
        ArmscanEnv({"a": wrist})


def test_reward_at_the_threshold_is_not_yet_a_success(phantom):
    rules = ArmscanEnv([phantom]).rules
    view = rules._labelled_view(phantom)
    assert not rules.is_solved(replace(view, reward=-rules.success_threshold))
    assert rules.is_solved(replace(view, reward=-rules.success_threshold / 2))
