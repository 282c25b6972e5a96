"""Wrong arguments of agents and networks."""

from dataclasses import fields

import pytest
from hypothesis import given

from armscan.agents import MLP, SAC, Exhaustive, Multimodal, OptunaSearch, PlaneFinder, Regression
from armscan.errors import InvalidValueError
from tests.support.junk import SETTINGS, is_answered, junk, result_of


@pytest.mark.parametrize("changed", [field.name for field in fields(SAC)])
@SETTINGS
@given(value=junk)
def test_sac_with_junk(changed, value):
    assert is_answered(lambda: SAC(**{"network": MLP()} | {changed: value}))
    assert changed != "network" or result_of(lambda: SAC(network=value)) is None


@pytest.mark.parametrize(
    ("kind", "changed"),
    [(kind, field.name) for kind in (Exhaustive, OptunaSearch, PlaneFinder, Regression) for field in fields(kind)],
    ids=lambda value: getattr(value, "__name__", value),
)
@SETTINGS
@given(value=junk)
def test_agents_to_compare_with_with_junk(kind, changed, value):
    assert is_answered(lambda: kind(**({"network": MLP()} if kind is Regression else {}) | {changed: value}))


@SETTINGS
@given(value=junk)
def test_mlp_with_junk(value):
    assert is_answered(lambda: MLP(value))
    assert is_answered(lambda: MLP([value]))
    assert result_of(lambda: MLP(activation=value)) is None


@pytest.mark.parametrize(
    ("kind", "name"), [(PlaneFinder, "hidden_sizes"), (Multimodal, "vector_sizes"), (Multimodal, "head_sizes")]
)
def test_network_that_needs_a_layer_refuses_none(kind, name):
    with pytest.raises(InvalidValueError, match=rf"{name} is \[\], but it must be a list of 1 or more whole numbers"):
        kind(**{name: []})
