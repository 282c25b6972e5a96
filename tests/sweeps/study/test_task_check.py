"""Checks that the trials of a study have the same task."""

import pytest

from armscan.config.compose import compose_run
from armscan.errors import InvalidValueError
from armscan.sweeps.study.task_check import check_objectives, check_same_task

DATA = ["data.n_training=2", "data.n_validation=1", "data.n_test=1"]


def config_of(*overrides):
    return compose_run([*DATA, *overrides])[0]


def compares(objectives, override):
    """Return whether trials with an override compare with the control's."""
    try:
        check_same_task(objectives, config_of(), config_of(override))
    except InvalidValueError:
        return False
    return True


@pytest.mark.parametrize(
    ("override", "changed"),
    [
        ("env.max_steps=5", "env.max_steps"),
        ("env.success_threshold=0.3", "env.success_threshold"),
        ("env.ends=on_budget", "env.ends"),
        ("projection=zy", "projection"),
    ],
)
def test_trials_of_another_task_do_not_compare(override, changed):
    with pytest.raises(InvalidValueError, match=rf"another task than the control's \({changed}.*mean_steps would not"):
        check_same_task(["mean_steps"], config_of(), config_of(override))


@pytest.mark.parametrize("override", ["env.max_steps=5", "reward=agreement", "env.clustering=metric"])
def test_distances_compare_however_episodes_are_rewarded_and_end(override):
    assert compares(["on_plane_5mm_10deg", "median_distance_mm", "training_s"], override)
    assert not compares(["on_plane_5mm_10deg", "success_rate"], override)


@pytest.mark.parametrize("override", ["projection=zy", "env.transform.rx_deg=10", "env.start=random"])
def test_nothing_compares_where_agents_move_or_begin_elsewhere(override):
    with pytest.raises(InvalidValueError, match="on_plane_5mm_10deg would not compare"):
        check_same_task(["on_plane_5mm_10deg"], config_of(), config_of(override))


@pytest.mark.parametrize(
    ("override", "parts"),
    [("data.n_validation=2", "validation"), ("data.n_test=2", "test"), ("data.version=2", "validation and test")],
)
def test_trials_on_other_volumes_do_not_compare(override, parts):
    with pytest.raises(InvalidValueError, match=f"the {parts} volumes are not the control's"):
        check_same_task(["mean_steps"], config_of(), config_of(override))


@pytest.mark.parametrize(
    "override", ["data.n_training=3", "obs=slice", "stack=2", "env.transform.scale=0.1", "agent=ppo"]
)
def test_what_an_agent_sees_and_learns_from_may_differ(override):
    assert compares(["mean_steps"], override)


@pytest.mark.parametrize(
    ("objectives", "line"),
    [
        ({"success_rate": "minimize"}, "but it must be 'maximize success_rate'"),
        ({"on_plane_5mm_10deg": "minimize"}, "but it must be 'maximize on_plane_5mm_10deg'"),
        ({"mean_steps": "maximize"}, "but it must be 'minimize mean_steps'"),
        ({"mean_dice": "minimize"}, "but it must be 'maximize mean_dice'"),
    ],
)
def test_objective_in_the_wrong_direction_is_refused(objectives, line):
    with pytest.raises(InvalidValueError, match=line):
        check_objectives(objectives, config_of())


def test_steps_alone_are_no_objective_of_agents_that_stop():
    config = config_of("env.ends=on_stop")
    with pytest.raises(InvalidValueError, match="the best agent would stop at once"):
        check_objectives({"mean_steps": "minimize"}, config)
    check_objectives({"on_plane_5mm_10deg": "maximize", "mean_steps": "minimize"}, config)
