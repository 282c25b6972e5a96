"""Groups of trainings, and their names."""

import dataclasses

import pytest

from armscan.reports.groups import differing_rules, group_trainings
from armscan.stats.on_plane import OnPlane


def names(*trainings):
    return [group.name for group in group_trainings(trainings)[0]]


def test_groups_differ_by_more_than_the_seed_and_what_has_no_effect(make_training):
    same = {"agent.lr": "0.1", "tracking.uri": "a", "device": "cpu", "compute.device": "cpu", "data.cache_dir": "a"}
    other = {"agent.lr": "0.1", "tracking.uri": "b", "device": "cuda", "compute.device": "cuda", "data.cache_dir": "b"}
    trainings = [
        make_training(seed, params=each) for seed, each in enumerate((same, other, same | {"agent.lr": "0.2"}))
    ]
    groups, left_out = group_trainings(trainings)
    assert [[each.seed for each in group.trainings] for group in groups] == [["0", "1"], ["2"]]
    assert [(group.name, group.label) for group in groups] == [
        ("agent.lr=0.1", "1. lr=0.1"),
        ("agent.lr=0.2", "2. lr=0.2"),
    ]
    assert left_out == []


def test_labels_are_short(make_training):
    values = ("0.0011781448719376517", "1.1781448719376517e-07", "0.5")
    groups, _ = group_trainings([make_training(params={"agent.lr": value}) for value in values])
    assert [group.label for group in groups] == ["1. lr=0.001178", "2. lr=1.178e-07", "3. lr=0.5"]
    assert groups[0].title == "1. agent.lr=0.0011781448719376517"


def test_one_group_is_called_after_its_runs(make_training):
    assert names(make_training(0), make_training(1)) == ["sac"]


def test_what_refers_to_another_key_is_named_once(make_training):
    stacks = [{"stack": n, "env.stack": n, "obs.size": n, "env.observation.size": n} for n in "14"]
    assert names(*(make_training(params=each) for each in stacks)) == ["stack=1, obs.size=1", "stack=4, obs.size=4"]


def test_a_choice_stands_for_all_that_it_brings_but_for_what_its_own_groups_differ_by(make_training):
    sac = [{"agent._target_": "SAC", "agent.lr": lr, "agent.tau": "0.1", "stack": "1"} for lr in ("0.1", "0.2")]
    ppo = {"agent._target_": "PPO", "agent.lr": "0.3", "agent.clip": "0.2", "stack": "1"}
    trainings = [*(make_training(params=each) for each in sac), make_training(params=ppo, choices={"agent": "ppo"})]
    assert names(*trainings) == ["agent=sac, agent.lr=0.1", "agent=sac, agent.lr=0.2", "agent=ppo"]


def test_key_that_the_command_line_set_is_named_beside_the_choice(make_training):
    sac = make_training(params={"agent.lr": "0.5", "agent.tau": "0.1"}, overridden=frozenset({"agent", "agent.lr"}))
    ppo = make_training(params={"agent.lr": "0.3", "agent.clip": "0.2"}, choices={"agent": "ppo"})
    assert names(sac, ppo) == ["agent=sac, agent.lr=0.5", "agent=ppo"]


def test_groups_that_no_key_tells_apart_have_numbers(make_training):
    # As where a key is new.
    trainings = [make_training(params=each) for each in ({}, {"a": "1"}, {"b": "1"})]
    assert names(*trainings) == ["sac", "a=1", "b=1"]
    assert names(make_training(name="a=1"), make_training(params={"a": "1"})) == ["a=1 (1)", "a=1 (2)"]
    long = [make_training(params={"data.path": "x" * 200 + end}) for end in "ab"]
    labels = [group.label for group in group_trainings(long)[0]]
    assert len(set(labels)) == 2
    assert max(map(len, labels)) < 80


def test_of_several_runs_with_the_same_seed_one_counts(make_training):
    old, new, cut = (make_training(0, run_id=run_id, started_ms=at) for run_id, at in (("a", 1), ("b", 2), ("c", 3)))
    cut = make_training(0, run_id="c", started_ms=3, is_whole=False)
    (group,), left_out = group_trainings([old, new, cut, make_training(1)])
    assert [each.run_id for each in group.trainings] == ["b", f"{1:032x}"]
    assert [each.run_id for each in left_out] == ["a", "c"]


@pytest.mark.parametrize(
    ("key", "is_rule"),
    [
        ("env.success_threshold", True),
        ("projection", True),
        ("agent.lr", False),
        ("env.observation.normalised", False),
        ("env.stack", False),
    ],
)
def test_rules_that_differ_are_known(make_training, key, is_rule):
    groups, _ = group_trainings([make_training(params={key: value}) for value in "12"])
    assert differing_rules(groups) == ([key] if is_rule else [])


def test_rule_that_another_key_refers_to_is_known(make_training):
    groups, _ = group_trainings([make_training(params={"obs.targets": x, "reward.targets": x}) for x in "12"])
    assert differing_rules(groups) == ["reward.targets"]


def test_on_plane_rates_of_all_groups_have_the_limits_of_the_first(make_training):
    limits = ((5.0, 10.0), (2.0, 5.0))
    trainings = [
        dataclasses.replace(training, evaluation=dataclasses.replace(training.evaluation, on_plane=tuple(on_plane)))
        for training, on_plane in (
            (make_training(params={"a": "1"}), (OnPlane(*each) for each in limits)),
            (make_training(params={"a": "2"}), (OnPlane(*each) for each in reversed(limits))),
        )
    ]
    groups, _ = group_trainings(trainings)
    assert {group.trainings[0].evaluation.on_plane for group in groups} == {limits}
