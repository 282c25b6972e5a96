"""Wrong arguments of agents and networks."""

from dataclasses import fields

import pytest
from hypothesis import given

from armscan.agents import MLP, SAC

from ..junk import SETTINGS, junk, refuses


@pytest.mark.parametrize("changed", [field.name for field in fields(SAC)])
@SETTINGS
@given(value=junk)
def test_sac_with_junk(changed, value):
    refuses(lambda: SAC(**{"network": MLP()} | {changed: value}))
    assert changed != "network" or refuses(lambda: SAC(network=value)) is None


@SETTINGS
@given(value=junk)
def test_mlp_with_junk(value):
    refuses(lambda: MLP(value))
    refuses(lambda: MLP([value]))
    assert refuses(lambda: MLP(activation=value)) is None
