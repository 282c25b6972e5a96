"""Planes that agents find in volumes without a labelled plane."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InvalidValueError, OptimalPlaneError
from armscan.evaluation import agent_of_run
from armscan.evaluation.agent_search import AgentSearch
from armscan.evaluation.runner import prepare_on_volumes
from armscan.training.episode_seeds import EVALUATION_SEED
from armscan.training.episodes import play
from armscan.volumes import LabelVolume
from tests.support.tracked_runs import tracked


def source_of(folder, *overrides):
    return agent_of_run(f"sqlite:///{folder}/mlruns.db", tracked(folder, *overrides), {})


@pytest.mark.parametrize(
    "overrides",
    [
        ["projection=full", "env.success_threshold=0.5", "stack=2", "memory=2"],
        ["experiment=no_wrists", "env.max_steps=5"],
    ],
    ids=["sac", "plane_finder"],
)
def test_agent_finds_the_plane_of_its_episode_without_knowing_the_labelled_one(database, tmp_path, dataset, overrides):
    source = source_of(tmp_path, *overrides)
    volume = next(iter(dataset.values()))
    unlabelled = replace(volume, optimal_action=None)
    found = AgentSearch(source)(unlabelled)
    source.config.env.transform = None
    env = prepare_on_volumes(source, {"volumes": {volume.name: volume}}, own=pytest.fail)
    result = play(env.agent, env.envs["volumes"], volume.name, EVALUATION_SEED)
    assert found.action == env.envs["volumes"].get_wrapper_attr("episode").plane
    assert found.score == result.final_reward


def test_agent_whose_environment_holds_components_is_refused(database, tmp_path, dataset):
    source = source_of(tmp_path, "projection=zy")
    with pytest.raises(
        InvalidValueError, match=r"moves rz and ty only, and its environment holds rx and tx at the label"
    ):
        AgentSearch(source)


def test_plane_is_found_in_a_volume_whose_middle_shows_nothing(database, tmp_path, dataset):
    source, volume = source_of(tmp_path, "projection=full"), next(iter(dataset.values()))
    search = AgentSearch(source)

    def only(first, last):
        labels = np.zeros_like(volume.labels)
        kept = slice(*(int(part * labels.shape[1]) for part in (first, last)))
        labels[:, kept] = volume.labels[:, kept]
        return LabelVolume(labels, volume.spacing, "part")

    search(only(0.65, 0.72))
    with pytest.raises(OptimalPlaneError, match=r"^part: the agent's environment sees nothing at 7 values of ty"):
        search(only(0.62, 0.68))
