"""The collector, compared with Tianshou's own."""

from dataclasses import fields

import numpy as np
import pytest
import torch
from tianshou.data import Batch, Collector, VectorReplayBuffer

from armscan.agents import MLP, PPO, SAC, Compute, tianshou_learner
from armscan.agents.replay import Replay
from armscan.agents.step_collector import StepCollector
from armscan.envs import EnvFactory, SliceChannelsObservation
from tests.agents.conftest import SMALL_MULTIMODAL, SMALL_PPO, SMALL_SAC, setup_for
from tests.support.tensors import assert_same_tensors

OBSERVATIONS = {
    "vector": ({"max_steps": 7}, MLP((8,))),
    "remembering": ({"max_steps": 7, "stack": 3, "memory": 2}, MLP((8,))),
    "images": (
        {"max_steps": 4, "observation": SliceChannelsObservation(shape=(36, 36)), "stack": 2, "memory": 2},
        SMALL_MULTIMODAL,
    ),
}
MEASURED_S = ("collect_time", "collect_speed")
# Tianshou's are too low for episodes that PPO's collections cut in two.
LENGTHS = ("lens", "lens_stat")


@pytest.fixture
def of_tianshou(monkeypatch):
    """Return a function that makes learners use Tianshou's collector and buffer."""

    def switch():
        monkeypatch.setattr(
            tianshou_learner, "StepCollector", lambda *arguments: Collector(*arguments[:3], exploration_noise=True)
        )
        monkeypatch.setattr(
            Replay, "add", lambda self, batch, buffer_ids=None: plain_add(self, Batch(batch), buffer_ids)
        )

    plain_add = VectorReplayBuffer.add
    return switch


def make(kind, small, observed, phantom, rules=None, precision="float32", **changes):
    known, network = OBSERVATIONS[observed]
    env_factory = EnvFactory(**{"projection": "zy", "success_threshold": 0.5} | known | (rules or {}))
    setup = setup_for(env_factory, phantom, total_env_steps=400, compute=Compute("cpu", precision))
    return kind(network=network, **small | changes).agent(setup)


def collected(learner):
    """Statistics of each collection from here on."""
    gathered, collect = [], learner._collector.collect
    learner._collector.collect = lambda **arguments: gathered.append(collect(**arguments)) or gathered[-1]
    return gathered


def all_that_is_drawn(learner):
    """Return the states of all random generators."""
    rings = [learner._replay, *learner._replay.buffers]
    return [
        torch.get_rng_state().tolist(),
        [part.tolist() if isinstance(part, np.ndarray) else part for part in np.random.get_state()],  # noqa: NPY002
        [ring._random_state.get_state()[1].tolist() for ring in rings],
        [rng.bit_generator.state for rng in learner._envs._envs.unwrapped._rngs],
        [space.np_random.bit_generator.state for space in learner._envs._action_spaces],
    ]


def assert_same_stats(ours, theirs, left_out):
    assert len(ours) == len(theirs)
    for one, other in zip(ours, theirs, strict=True):
        for field in fields(other):
            if field.name in left_out:
                continue
            value, its_like = getattr(one, field.name), getattr(other, field.name)
            if field.name in MEASURED_S:
                assert value > 0
            elif isinstance(its_like, np.ndarray):
                np.testing.assert_array_equal(value, its_like)
                assert value.dtype == its_like.dtype
            else:
                assert value == its_like


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize("observed", list(OBSERVATIONS))
@pytest.mark.parametrize(("kind", "small"), [(SAC, SMALL_SAC), (PPO, SMALL_PPO)])
def test_transitions_statistics_and_draws_are_those_of_tianshous_collector(
    kind, small, observed, num_envs, phantom, of_tianshou
):
    # A small buffer is written over, in the middle of episodes.
    changes = {"num_envs": num_envs} | ({"buffer_size": 90} if kind is SAC else {})
    runs = []
    for collector in (StepCollector, Collector):
        if collector is Collector:
            of_tianshou()
        learner = make(kind, small, observed, phantom, **changes)
        assert type(learner._collector) is collector
        stats = collected(learner)
        learner.warm_up()
        metrics = [learner.learn(60) for _ in range(3)]
        for each in metrics:
            assert each.pop("speed/env_steps_per_s") > 0
            assert each.pop("speed/updates_per_s") > 0
            if kind is PPO:
                del each["train/length"], each["train/length_max"]
        # The generators of torch and NumPy are shared.
        runs.append((stats, metrics, all_that_is_drawn(learner), learner.state()))
    (ours, *our_metrics_and_draws, our_state), (theirs, *their_metrics_and_draws, their_state) = runs
    assert sum(each.n_collected_episodes for each in theirs) > 3
    assert_same_stats(ours, theirs, LENGTHS if kind is PPO else ())
    assert our_metrics_and_draws == their_metrics_and_draws
    assert_same_tensors(our_state, their_state)


def test_episodes_that_collections_of_ppo_cut_in_two_count_in_full(phantom):
    learner = make(PPO, SMALL_PPO, "vector", phantom, rules={"ends": "on_budget"})
    metrics = learner.learn(100)
    assert metrics["train/episodes"] == 14
    assert metrics["train/length"] == metrics["train/length_max"] == 7


def test_policy_that_collects_computes_in_the_precision_of_the_updates(phantom):
    learner = make(SAC, SMALL_SAC, "vector", phantom, precision="bfloat16")
    learner.warm_up()
    observations = learner._collector._pre_collect_obs_RO
    with torch.no_grad():
        of_updates = learner.actor(observations)[0]
        assert_same_tensors(learner._collector._means_and_stds(observations), of_updates)
        assert not torch.equal(learner.policy().actor(observations)[0][0], of_updates[0])


def test_either_collector_goes_on_from_the_others_checkpoint(phantom, of_tianshou):
    ours, resumed = (make(SAC, SMALL_SAC, "remembering", phantom) for _ in range(2))
    ours.warm_up()
    ours.learn(40)
    kept = ours.state()
    of_tianshou()
    theirs = make(SAC, SMALL_SAC, "remembering", phantom)
    states = []
    for each in (resumed, theirs):
        each.load_state(kept)
        each.learn(40)
        states.append(each.state())
    assert_same_tensors(*states)


def test_policy_may_act_by_its_mode_outside_of_training(phantom):
    learner = make(SAC, SMALL_SAC, "vector", phantom)
    learner.warm_up()
    stats = [learner._collector.collect(n_step=4) for _ in range(2)]
    assert learner._algorithm.policy.is_within_training_step is False
    before = torch.get_rng_state()
    learner._collector.collect(n_step=4)
    assert torch.equal(before, torch.get_rng_state())
    assert stats[0].pred_dist_std_array.shape == (4, 2)


def test_whole_episodes_hooks_and_other_policies_are_left_to_tianshou(phantom, monkeypatch):
    learner = make(SAC, SMALL_SAC, "vector", phantom)
    learner.warm_up()
    collector, seen = learner._collector, []
    assert collector.collect(n_episode=4).n_collected_episodes == 4
    collector.set_on_step_hook(lambda actions, transitions: seen.append(len(transitions)))
    assert collector.collect(n_step=4).n_collected_steps == 4
    assert seen == [2, 2]
    collector.set_on_step_hook(None)
    collector.collect(n_step=4)
    assert seen == [2, 2]
    monkeypatch.setattr(StepCollector, "_chosen_actions", None)
    learner._collector.policy.actor.__class__ = type("Custom", (type(collector.policy.actor),), {})
    assert collector.collect(n_step=4).n_collected_steps == 4


def test_weights_that_are_not_finite_are_refused_while_collecting(phantom):
    learner = make(SAC, SMALL_SAC, "vector", phantom)
    learner.warm_up()
    learner._algorithm.policy.actor.preprocess.model.model[0].weight.data[0, 0] = float("nan")
    with pytest.raises(ValueError, match="Normal"):
        learner._collector.collect(n_step=4)
