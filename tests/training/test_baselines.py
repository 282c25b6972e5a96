"""The baselines of an evaluation: which there are, and when their episodes are cached or played again."""

import pytest

from armscan.anatomy import LandmarkReward
from armscan.envs import EnvFactory
from armscan.training import baselines, evaluate_baselines
from armscan.volumes import load_phantoms


@pytest.fixture
def volumes():
    return load_phantoms([2_000_000])


@pytest.fixture
def played(monkeypatch, tmp_path):
    """Return the agents whose episodes are played instead of taken from the cache, which is empty at first."""
    monkeypatch.setenv("ARMSCAN_CACHE", str(tmp_path))
    agents, play = [], baselines.evaluate

    def evaluate(agent, env, **how):
        agents.append(type(agent).__name__)
        return play(agent, env, **how)

    monkeypatch.setattr(baselines, "evaluate", evaluate)
    return agents


def test_sweep_stands_beside_random_planes_where_one_component_is_free(volumes, played):
    names = [
        list(evaluate_baselines(EnvFactory(projection=projection, max_steps=3).make_env(volumes), n_episodes=1, seed=0))
        for projection in ("y", ["rz"], "zy")
    ]
    assert names == [["random", "sweep 5 mm"], ["random", "sweep 10 deg"], ["random"]]


def test_episodes_are_kept_for_the_same_volumes_and_rules_with_any_observation(volumes, played):
    first = evaluate_baselines(EnvFactory(max_steps=3).make_env(volumes), n_episodes=2, seed=0)
    again = evaluate_baselines(
        EnvFactory(max_steps=3, observation="action_reward", stack=2).make_env(volumes), n_episodes=2, seed=0
    )
    assert first == again
    assert played == ["RandomAgent", "ExhaustiveAgent"]


@pytest.mark.parametrize(
    "changed",
    [
        {"max_steps": 4},
        {"success_threshold": 0.01},
        {"start": "random"},
        {"transform": None},
        {"ends": "on_stop"},
        {"targets": (7, 5, 1), "success_threshold": 0.9},
        {"translation_bounds_mm": (200.0, 200.0)},
    ],
)
def test_other_rules_are_played_anew(volumes, played, changed):
    for rules in ({}, changed):
        evaluate_baselines(EnvFactory(**{"max_steps": 3} | rules).make_env(volumes), n_episodes=1, seed=0)
    assert len(played) == 4


def test_other_episodes_or_volumes_are_played_anew(volumes, played):
    env = EnvFactory(max_steps=3).make_env(volumes)
    evaluate_baselines(env, n_episodes=1, seed=0)
    evaluate_baselines(env, n_episodes=1, seed=1)
    evaluate_baselines(env, n_episodes=2, seed=0)
    evaluate_baselines(EnvFactory(max_steps=3).make_env(load_phantoms([2_000_001])), n_episodes=1, seed=0)
    assert len(played) == 8


def test_volume_of_another_subject_is_played_anew(volumes, played):
    ((name, volume),) = volumes.items()
    for subject in (None, "S1"):
        env = EnvFactory(max_steps=3).make_env({name: volume.of_subject(subject)})
        assert evaluate_baselines(env, n_episodes=1, seed=0)["random"].subject_of == {name: subject or name}
    assert len(played) == 4


def test_rules_of_others_are_never_kept(volumes, played):
    class Mine(LandmarkReward):
        pass

    env = EnvFactory(max_steps=3, reward=Mine()).make_env(volumes)
    for _ in range(2):
        evaluate_baselines(env, n_episodes=1, seed=0)
    assert len(played) == 4


def test_damaged_cache_is_played_again(volumes, played, tmp_path):
    env = EnvFactory(max_steps=3).make_env(volumes)
    first = evaluate_baselines(env, n_episodes=1, seed=0)
    for file in (tmp_path / "baselines").iterdir():
        file.write_text('[{"volume": 1}]')
    assert evaluate_baselines(env, n_episodes=1, seed=0) == first
    assert len(played) == 4
