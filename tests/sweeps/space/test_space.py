"""Search spaces: what they may contain, what a trial is given, and how that is written."""

import math

import optuna
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st
from optuna.trial import FixedTrial

from armscan.config.literal import hydra_literal
from armscan.errors import InvalidValueError
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.space.space import Space

DESCRIBED = {
    "network": {"choices": ["mlp", "multimodal"]},
    "network.hidden_sizes": {"choices": [[64, 64], [128, 128]], "when": {"network": "mlp"}},
    "agent.lr": {"low": 1e-4, "high": 1e-2, "log": True},
    "agent.batch_size": {"low": 64, "high": 256, "step": 64},
    "agent.gamma": {"low": 0, "high": 0.99},
    "training.solved": {"choices": [None, True, 3]},
}


def test_space_gives_a_trial_what_is_searched_beside_its_choices():
    space, study = Space.read(DESCRIBED), optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    seen = [space.suggest(study.ask()) for _ in range(60)]
    assert all(("network.hidden_sizes" in chosen) == (chosen["network"] == "mlp") for chosen in seen)
    assert {chosen["agent.batch_size"] for chosen in seen} == {64, 128, 192, 256}
    assert {chosen["network"] for chosen in seen} == {"mlp", "multimodal"}
    assert all(1e-4 <= chosen["agent.lr"] <= 1e-2 for chosen in seen)
    assert sum(chosen["agent.lr"] < 1e-3 for chosen in seen) > 15
    assert any(0 < chosen["agent.gamma"] < 0.99 for chosen in seen)


def test_space_is_written_as_the_command_line_has_it():
    chosen = {"network": "mlp", "network.hidden_sizes": "[64,64]", "agent.lr": 1e-4, "a.b": None, "c": False}
    texts = ["it's, odd", "a\\b", "a\\", "a\\'b", "true", "Null", "nan", "1e3"]
    values = [OverridesParser.create().parse_override(f"a={hydra_literal(text)}").value() for text in texts]
    assert [value if isinstance(value, str) else value.text for value in values] == texts
    words = overrides_of({**chosen, "d": "it's, odd"})
    assert words[:5] == ["network=mlp", "network.hidden_sizes=[64,64]", "agent.lr=0.0001", "a.b=null", "c=false"]
    read = [override.value() for override in OverridesParser.create().parse_overrides(words)]
    assert [str(value) if hasattr(value, "text") else value for value in read] == [
        *("mlp", [64, 64], 1e-4, None, False, "it's, odd")
    ]
    assert hydra_literal({"a": [1, {"b": True}]}) == "{a:[1,{b:true}]}"


def test_space_extremes_have_every_choice_and_both_ends():
    extremes = list(Space.read(DESCRIBED).extremes())
    assert {"network": "mlp", "network.hidden_sizes": "[128,128]"} in extremes
    for name, values in {
        "agent.lr": (1e-4, 1e-2),
        "agent.batch_size": (64, 256),
        "training.solved": (None, True, 3),
    }.items():
        assert [one[name] for one in extremes if name in one] == list(values)


def test_space_completes_choices_as_a_trial_has_them():
    completed = Space.read(DESCRIBED).completed({"network": "multimodal", "agent.lr": 1e-2})
    assert completed == {
        "network": "multimodal",
        "agent.lr": 1e-2,
        "agent.batch_size": 64,
        "agent.gamma": 0,
        "training.solved": None,
    }


@pytest.mark.parametrize(("network", "is_there"), [("mlp", True), ("multimodal", False), ("auto", False)])
def test_space_without_what_is_fixed_keeps_what_this_allows(network, is_there):
    space = Space.read(DESCRIBED).without({"network": network, "agent.lr": 1})
    others = ["agent.batch_size", "agent.gamma", "training.solved"]
    assert [each.name for each in space.parameters] == ["network.hidden_sizes"] * is_there + others
    chosen = space.suggest(optuna.create_study().ask())
    assert ("network.hidden_sizes" in chosen) == is_there


def test_space_without_what_is_fixed_lacks_what_needs_what_is_gone():
    chain = {
        "a": {"choices": [1, 2]},
        "b": {"choices": [1, 2], "when": {"a": 1}},
        "c": {"choices": [1, 2], "when": {"b": 2}},
    }
    assert list(Space.read(chain).extremes())[-1] == {"a": 1, "b": 2, "c": 2}
    assert Space.read(chain).without({"a": 2}).parameters == ()
    assert [each.name for each in Space.read(chain).without({"b": 2}).parameters] == ["a", "c"]


@pytest.mark.parametrize("when", [{"agent": "ppo", "gamma": 0.5}, {"gamma": 0.5, "agent": "ppo"}], ids=str)
def test_space_extremes_are_only_such_as_a_trial_can_have(when):
    space = Space.read(
        {
            "agent": {"choices": ["sac", "ppo"]},
            "gamma": {"choices": [0.5, 0.9], "when": {"agent": ["sac", "ppo"]}},
            "clip": {"choices": [1], "when": when},
        }
    )
    assert list(space.extremes())[-1] == {"agent": "ppo", "gamma": 0.5, "clip": 1}


@pytest.mark.parametrize(
    ("described", "line"),
    [
        (None, "study.space is None, but it must have at least one key to search"),
        ({}, "study.space is {}, but it must have at least one key"),
        ({"a b": {"choices": [1]}}, "study.space.a b: 'a b' is not a key of the configuration"),
        ({"a": 3}, "study.space.a is 3, but it must have low and high, or choices"),
        ({"a": {"low": 3}}, "study.space.a.high is not set, but it must be"),
        ({"a": {"choices": []}}, "study.space.a.choices is [], but it must be a list of values"),
        ({"a": {"choices": [1, 1]}}, "study.space.a.choices is [1, 1], but it must be a list of values, none of them"),
        ({"a": {"choices": [1], "low": 1}}, "'low': 1}, but it must have low and high, or choices: study.space.a.cho"),
        ({"a": {"choices": [1], "log": 1}}, "there is no key 'log' in study.space.a, but only when or choices"),
        (
            {"study.seed": {"choices": [1]}},
            "study.space.study.seed: 'study.seed' sets how a study is run, evaluated or stored",
        ),
        ({"a": {"low": 1, "high": 2, "max": 1}}, "there is no key 'max' in study.space.a, but only when, low, high"),
        ({"a": {"low": 2, "high": 1}}, "study.space.a: `low <= high` must hold, but got (low=2, high=1)"),
        ({"a": {"low": "x", "high": 1}}, "study.space.a.low is 'x', but it must be a finite number"),
        (
            {"a": {"low": 0.0, "high": 1.0, "log": True}},
            "study.space.a.low is 0.0, but it must be above 0",
        ),
        ({"a": {"low": -1, "high": 1, "log": True}}, "study.space.a.low is -1, but it must be above 0"),
        ({"a": {"low": 1.0, "high": 2.0, "log": 1}}, "study.space.a.log is 1, but it must be true or false"),
        (
            {"a": {"low": 1, "high": 9, "log": True, "step": 2}},
            "study.space.a: Samplers and other components in Optuna only accept step is 1 when `log`",
        ),
        ({"a": {"low": 1, "high": 9, "step": 0}}, "study.space.a: `step > 0` must hold, but got step=0"),
        ({"a": {"low": 0.0, "high": 1.0, "step": 2.0}}, "but the range is not divisible by `step`"),
        (
            {"b": {"choices": [1]}, "a": {"choices": [1], "when": {"b": []}}},
            "study.space.a.when can never apply",
        ),
        (
            {
                "a": {"choices": [1, 2]},
                "b": {"choices": [1], "when": {"a": 1}},
                "c": {"choices": [1], "when": {"b": 1, "a": 2}},
            },
            "study.space.c.when can never apply",
        ),
        (
            {"a": {"low": 0.0, "high": 0.1, "step": 0.03}},
            "the range is not divisible by `step`. It will be replaced with [0.0, 0.09]",
        ),
        (
            {"a": {"low": 1, "high": 8, "step": 5}},
            "the range is not divisible by `step`. It will be replaced with [1, 6]",
        ),
        ({"a": {"choices": [1], "when": 3}}, "study.space.a.when is 3, but it must be choices of other keys"),
        ({"a": {"choices": [1], "when": {"b": 1}}}, "study.space.a.when names 'b', but it must be a key with choices"),
        (
            {"b": {"choices": [1, 2]}, "a": {"choices": [1], "when": {"b": 3}}},
            "study.space.a.when.b is 3, but it must be 1 or 2",
        ),
    ],
    ids=str,
)
def test_space_refuses_what_is_none_in_one_line(described, line):
    with pytest.raises(InvalidValueError) as error:
        Space.read(described)
    assert line in str(error.value)


@given(
    st.one_of(st.integers(-3, 12), st.floats(-3, 12), st.booleans(), st.sampled_from(["a", "[8,8]", "1"]), st.none())
)
def test_values_fit_that_the_distribution_of_a_trial_would_accept(value):
    described = {
        "a": {"low": 1, "high": 9, "step": 2},
        "b": {"low": 0.5, "high": 8.5, "step": 0.5},
        "c": {"low": 1e-2, "high": 10.0, "log": True},
        "d": {"choices": [1, "a", [8, 8], None, True]},
    }
    is_number = type(value) in (int, float)
    lies_in = {
        "a": type(value) is int and value in range(1, 10, 2),
        "b": is_number and 0.5 <= value <= 8.5 and value % 0.5 == 0,
        "c": is_number and 1e-2 <= value <= 10.0,
        "d": any(type(value) is type(each) and value == each for each in (1, "a", "[8,8]", None, True)),
    }
    for name, each in described.items():
        chosen, misfit = Space.read({name: each}).fit({name: value})
        assert (misfit is None) is lies_in[name]
        if misfit is None:
            assert Space.read({name: each}).suggest(FixedTrial({name: value})) == {name: value}
        else:
            assert chosen == {}
            assert misfit.endswith("is not in the space")


@given(st.one_of(st.integers(-3, 20), st.floats(-3, 20), st.booleans(), st.sampled_from(["a", "1"]), st.none()))
@pytest.mark.parametrize(
    ("described", "allowed"),
    [
        ({"low": 1, "high": 7, "step": 3}, [1, 4, 7]),
        ({"low": 1, "high": 9, "log": True}, range(1, 10)),
        ({"low": 0.5, "high": 3.0, "step": 0.5}, [0.5, 1.0, 1.5, 2.0, 2.5, 3.0]),
        ({"low": 0.1, "high": 0.7, "step": 0.1}, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]),
        ({"low": 1e-2, "high": 10.0, "log": True}, [1e-2, 10.0]),
        ({"choices": [None, True, 0.5, 0.9, 0.95]}, [0.5, 0.9, 0.95]),
    ],
    ids=str,
)
def test_number_outside_of_the_space_becomes_the_nearest_in_it(described, allowed, value):
    space = Space.read({"a": described})
    exact, _ = space.fit({"a": value})
    chosen, misfit = space.fit({"a": value}, nearest=True)
    if exact or type(value) not in (int, float):
        assert chosen == exact
        assert (misfit is None) == bool(exact)
    else:
        assert misfit is None
        assert space.suggest(FixedTrial(chosen)) == chosen
        scale = math.log if "choices" in described and value > 0 else float
        distances = [abs(scale(each) - scale(value)) for each in allowed]
        assert abs(scale(chosen["a"]) - scale(value)) == pytest.approx(min(distances))


def test_nearest_learning_rate_of_several_is_the_nearest_by_ratio():
    space = Space.read({"agent.lr": {"choices": [1e-6, 1e-3]}})
    assert space.fit({"agent.lr": 2e-4}, nearest=True)[0] == {"agent.lr": 1e-3}


@pytest.mark.parametrize(("value", "expected"), [(1.0, 1), (1, 1), (0.1, 0.1), (True, None), (2, None)])
def test_choice_is_found_by_its_value(value, expected):
    space = Space.read({"agent.lr_end_factor": {"choices": [0.1, 1]}})
    chosen, misfit = space.fit({"agent.lr_end_factor": value})
    assert chosen == ({} if expected is None else {"agent.lr_end_factor": expected})
    assert type(chosen.get("agent.lr_end_factor")) is type(expected)
    assert (misfit is None) == (expected is not None)
