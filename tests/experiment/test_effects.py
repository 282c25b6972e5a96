"""Settings that have no effect."""

import pytest

from armscan.config.compose import compose
from armscan.envs import ArmscanEnv
from armscan.errors import InvalidValueError
from armscan.experiment.effects import check_effects, unused_network


@pytest.mark.parametrize("override", ["network=mlp", "network.vector.hidden_sizes=[8]"])
def test_network_and_memory_without_effect_are_refused(override):
    for agent in ("exhaustive", "sac"):
        check_effects(compose([f"agent={agent}", override, "memory=2"]), [override])
    check_effects(compose(["agent=residual_sac", override]), [override])
    with pytest.raises(InvalidValueError, match=r"'network.*' has no effect: agent=plane_finder has"):
        check_effects(compose(["agent=plane_finder", override]), ["agent=plane_finder", override])
    for agent in ("plane_finder", "residual_sac"):
        with pytest.raises(InvalidValueError, match="memory is 2, but a plane finder takes no best actions"):
            check_effects(compose([f"agent={agent}", "memory=2"]), [])


@pytest.mark.parametrize("part", ["validation", "test"])
def test_number_of_phantoms_beside_volumes_of_the_folder_is_refused(part):
    override = f"data.n_{part}=3"
    mixed = ["data=mixed", "data.path=wrists", override]
    with pytest.raises(
        InvalidValueError, match=f"'{override}' has no effect: the {part} volumes are those of data.path"
    ):
        check_effects(compose(mixed), [*mixed])
    check_effects(compose([*mixed, f"data.{part}=phantoms"]), [*mixed])
    check_effects(compose([override]), [override])


@pytest.mark.parametrize(("observation", "unused"), [("cluster", "images"), ("slice", "vector")])
def test_network_that_the_observation_does_not_choose_is_named(phantom, observation, unused):
    space = ArmscanEnv([phantom], observation=observation).observation_space
    overrides = ["seed=1", "network.vector.hidden_sizes=[8]", "network.images.head_sizes=[8]"]
    assert unused_network(compose(overrides), space, overrides).startswith(f"network.{unused}.")
    assert unused_network(compose(["network=mlp"]), space, ["network=mlp"]) is None
