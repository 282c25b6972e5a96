"""Whole episodes, and what they add up to."""

import math
from dataclasses import replace

import numpy as np
import pytest

from armscan.envs import make_armscan_env
from armscan.errors import InvalidValueError
from armscan.training import Evaluation, MetricEstimates, ResultTable, evaluate
from tests.training.test_train import evaluation_of


class Still:
    """Stays at a plane, by default in the middle."""

    def __init__(self, action=0.0):
        self._action = action

    def begin(self, *, seed, bounds):
        pass

    def act(self, observation, reward):
        return np.array([self._action])


class Oracle:
    """Knows the optimal plane: first resets the environment to the episode of a seed, counted from `first_seed`."""

    def __init__(self, env, first_seed):
        self._env, self._first_seed = env.unwrapped, first_seed

    def begin(self, *, seed, bounds):
        names = list(self._env.volumes)
        self._env.reset(seed=seed, options={"volume": names[(seed - self._first_seed) % len(names)]})
        self._scene = self._env.scene

    def act(self, observation, reward):
        return self._scene.optimum_normalised[3:]


def test_evaluate_visits_the_volumes_in_turn(dataset):
    env = make_armscan_env(dataset, max_steps=2)
    evaluation = evaluate(Oracle(env, 5), env, n_episodes=6, seed=5)
    names = list(dataset)
    assert [episode.volume for episode in evaluation.episodes] == [*names, *names[:2]]
    assert [episode.seed for episode in evaluation.episodes] == [5, 6, 7, 8, 9, 10]
    assert evaluation.success_rate == 1.0
    assert evaluation.mean_steps == 1.0
    assert evaluation.metrics()["mean_distance_mm"] == pytest.approx(0, abs=1e-6)


def test_evaluate_gives_every_agent_the_same_episodes(dataset):
    env = make_armscan_env(dataset, max_steps=3)
    starts = [
        [episode.starts_solved for episode in evaluate(agent, env, n_episodes=12, seed=1).episodes]
        for agent in (Still(), Oracle(env, 1))
    ]
    assert starts[0] == starts[1]


def test_evaluate_counts_episodes_that_start_solved_apart(dataset):
    env = make_armscan_env(dataset, max_steps=3)
    metrics = evaluate(Still(), env, n_episodes=40, seed=0).metrics()
    n_solved = metrics["episodes_started_solved"]
    assert 0 < n_solved < 40
    assert metrics["success_rate"] == n_solved / 40
    assert metrics["success_rate_not_started_solved"] == 0.0
    assert metrics["mean_steps_not_started_solved"] == 3.0
    assert metrics["mean_steps"] == (n_solved + 3 * (40 - n_solved)) / 40


def test_episode_of_the_optimal_plane_shows_its_slice(dataset):
    env = make_armscan_env(dataset, max_steps=2)
    for episode in evaluate(Oracle(env, 5), env, n_episodes=4, seed=5).episodes:
        assert episode.mean_dice == pytest.approx(1.0, abs=0.01)
        assert episode.seconds_per_plane > 0


def test_episode_says_how_far_the_nerves_area_is_from_that_on_the_optimal_plane(phantom):
    env = make_armscan_env([phantom], max_steps=1, transform=None)
    (episode,) = evaluate(Still(), env, n_episodes=1, seed=0).episodes
    env.reset(seed=0)
    env.step(np.zeros(1))
    areas = [
        int((each == 4).sum()) for each in (env.unwrapped.episode.view.slice_xz, phantom.slice(phantom.optimal_action))
    ]
    pixel_mm2 = phantom.pixel_mm[0] * phantom.pixel_mm[1]
    assert areas[0] != areas[1]
    assert episode.nerve_area_error_mm2 == pytest.approx(abs(areas[0] - areas[1]) * pixel_mm2)
    assert episode.nerve_area_error_percent == pytest.approx(100 * abs(areas[0] - areas[1]) / areas[1])
    figures = MetricEstimates.of(Evaluation((episode, replace(episode, nerve_area_error_mm2=None))))
    assert figures.estimate("median_nerve_area_error_mm2").value == pytest.approx(episode.nerve_area_error_mm2)
    # The table says that these are not all episodes.
    assert figures.estimate("nerve_shown_rate").value == 0.5
    assert "nerve on labelled plane" in [column.title for column in ResultTable({"agent": figures}).quantities]


def test_nerve_is_not_available_where_volumes_have_none(phantom):
    without = replace(phantom, labels=np.where(phantom.labels == 4, 0, phantom.labels))
    evaluation = evaluate(Still(), make_armscan_env([without], max_steps=1), n_episodes=2, seed=0)
    assert {episode.nerve_area_error_mm2 for episode in evaluation.episodes} == {None}
    figures = MetricEstimates.of(evaluation)
    assert math.isnan(figures.estimate("median_nerve_area_error_percent").value)
    assert not any("nerve" in column.title for column in ResultTable({"agent": figures}).quantities)
    assert Evaluation.of_dict(evaluation.to_dict()) == evaluation


def test_episodes_of_older_evaluations_say_nothing_of_the_nerve():
    contents = evaluation_of(1, 3).to_dict()
    for episode in contents["episodes"]:
        del episode["nerve_area_error_mm2"], episode["nerve_area_error_percent"]
    assert Evaluation.of_dict(contents) == evaluation_of(1, 3)
    contents["episodes"][0]["nerve_area_error_mm2"] = "1"
    with pytest.raises(InvalidValueError, match="nerve_area_error_mm2 is '1', but it must be a finite float"):
        Evaluation.of_dict(contents)


class Thrice:
    """Tries three places, the middle one the best."""

    def begin(self, *, seed, bounds):
        self._places = iter((-1.0, 0.0, 1.0))

    def act(self, observation, reward):
        return np.array([next(self._places)])


def test_best_reward_is_that_of_the_planes_that_were_chosen(dataset):
    env = make_armscan_env(dataset, max_steps=3, success_threshold=0.001)
    episodes = [each for each in evaluate(Thrice(), env, n_episodes=8, seed=0).episodes if not each.is_success]
    assert all(episode.best_reward >= episode.final_reward for episode in episodes)
    assert any(episode.best_reward > episode.final_reward for episode in episodes)
    assert all(type(episode.dice_bones) is float and 0.0 <= episode.mean_dice < 0.9 for episode in episodes)


def test_episodes_are_equal_however_long_they_took(dataset):
    env = make_armscan_env(dataset, max_steps=3)
    assert evaluate(Still(), env, n_episodes=4, seed=0) == evaluate(Still(), env, n_episodes=4, seed=0)


def test_evaluation_without_episodes_has_no_means():
    assert math.isnan(Evaluation(()).mean_steps)


def test_evaluation_is_ready_for_json():
    import json

    contents = json.loads(json.dumps(evaluation_of(1, 3).to_dict()))
    assert contents["metrics"]["mean_steps"] == 2.0
    assert len(contents["episodes"]) == 2


def test_evaluate_refuses_no_episodes(dataset):
    with pytest.raises(InvalidValueError, match="episodes is 0"):
        evaluate(Still(), make_armscan_env(dataset), n_episodes=0, seed=0)
