"""Arbitrary arguments, actions and options: accepted if valid, otherwise refused by the project's own errors."""

import pickle
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armscan.envs import (
    ActionBounds,
    ArmscanEnv,
    ArmscanVectorEnv,
    BestActionMemory,
    ClusterObservation,
    EnvFactory,
    FrameStack,
    ManipulatorAction,
    MergedObservation,
    MetricSliceObservation,
    MultiBoxSpace,
    RandomTransform,
    SliceChannelsObservation,
    SliceObservation,
    VectorBestActionMemory,
    VectorFrameStack,
    make_armscan_env,
    make_armscan_vector_env,
)
from armscan.envs.actions import free_components
from armscan.errors import ArmscanError, InvalidValueError, OptimalPlaneError
from armscan.volumes import LabelVolume, RigidTransform
from tests.support.junk import SETTINGS, is_answered, junk, result_of

RULES = [
    "volumes",
    "observation",
    "flat",
    "projection",
    "reward",
    "targets",
    "clustering",
    "success_threshold",
    "ends",
    "max_steps",
    "start",
    "rotation_bounds_deg",
    "translation_bounds_mm",
    "transform",
]
WRAPPER_RULES = ["stack", "stack_exclude", "memory", "stack_memory"]


def works(env):
    """Return whether an environment works, or refuses with one of armscan's own errors; True if there is none."""
    if env is None:
        return True
    contains = env.observation_space.contains
    try:
        return contains(env.reset(seed=0)[0]) and contains(env.step(env.action_space.sample())[0])
    except ArmscanError:
        return True


@pytest.mark.parametrize("rule", [*RULES, "render_mode"])
@SETTINGS
@given(value=junk)
def test_env_with_junk(wrist, rule, value):
    assert works(result_of(lambda: ArmscanEnv(**{"volumes": [wrist]} | {rule: value})))


@pytest.mark.parametrize("rule", WRAPPER_RULES)
@pytest.mark.parametrize("others", [{}, {"stack": 2, "memory": 1, "flat": False}], ids=["bare", "wrapped"])
@SETTINGS
@given(value=junk)
def test_made_env_with_junk(wrist, others, rule, value):
    arguments = others | {rule: value}
    env_factory = EnvFactory(**arguments)
    assert works(result_of(lambda: make_armscan_env([wrist], **arguments)))
    assert works(result_of(lambda: env_factory.make_env([wrist])))
    assert works(result_of(lambda: make_armscan_vector_env(2, [wrist], **arguments)))
    assert works(result_of(lambda: env_factory.make_vector_env(2, [wrist])))


@pytest.mark.parametrize(
    "argument", ["num_envs", "volumes", "autoreset_mode", "render_mode", "projection", "success_threshold"]
)
@SETTINGS
@given(value=junk)
def test_vector_env_with_junk(wrist, argument, value):
    assert works(result_of(lambda: ArmscanVectorEnv(**{"num_envs": 2, "volumes": [wrist]} | {argument: value})))


@SETTINGS
@given(rules=st.dictionaries(st.sampled_from(RULES + WRAPPER_RULES), junk, min_size=2, max_size=3))
def test_env_with_several_kinds_of_junk(wrist, rules):
    assert works(result_of(lambda: make_armscan_env(**{"volumes": [wrist]} | rules)))


@pytest.mark.parametrize("argument", [field.name for field in fields(RandomTransform)])
@SETTINGS
@given(value=junk)
def test_random_transform_with_junk(wrist, argument, value):
    transform = result_of(lambda: RandomTransform(**{argument: value}))
    if transform is not None:
        assert works(result_of(lambda: ArmscanEnv([wrist], transform=transform)))


@SETTINGS
@given(junk, junk)
def test_action_bounds_and_planes_with_junk(rotation, translation):
    for kind in (ActionBounds, ManipulatorAction, RigidTransform):
        assert is_answered(lambda kind=kind: kind(rotation, (1.0, 1.0)))
        assert is_answered(lambda kind=kind: kind((1.0, 1.0), translation))
    assert is_answered(lambda: RigidTransform(centre_mm=rotation))
    assert is_answered(lambda: ManipulatorAction.from_array(rotation))
    assert is_answered(lambda: free_components(rotation))


@SETTINGS
@given(value=junk)
def test_observations_with_junk(wrist, value):
    made = [
        result_of(lambda: ClusterObservation(normalised=value)),
        result_of(lambda: ClusterObservation(targets=value)),
        result_of(lambda: MergedObservation(value)),
        result_of(lambda: MergedObservation([value])),
    ]
    for kind in (SliceObservation, SliceChannelsObservation):
        made += [result_of(lambda kind=kind: kind(crop=value)), result_of(lambda kind=kind: kind(shape=value))]
    for argument in ("field_of_view_mm", "pixel_mm"):
        made.append(result_of(lambda argument=argument: MetricSliceObservation(**{argument: value})))
    for observation in made:
        if observation is not None:
            assert works(result_of(lambda observation=observation: ArmscanEnv([wrist], observation=observation)))
    assert is_answered(lambda: MultiBoxSpace(value))
    assert is_answered(lambda: MultiBoxSpace({"a": value}))


@SETTINGS
@given(value=junk)
def test_wrappers_with_junk(wrist, value):
    one, many = ArmscanEnv([wrist]), ArmscanVectorEnv(2, [wrist])
    for wrapper, env in (
        (FrameStack, one),
        (BestActionMemory, one),
        (VectorFrameStack, many),
        (VectorBestActionMemory, many),
    ):
        assert works(result_of(lambda wrapper=wrapper, env=env: wrapper(env, value)))
        assert result_of(lambda wrapper=wrapper: wrapper(value, 2)) is None
    for wrapper, env in ((FrameStack, one), (VectorFrameStack, many)):
        assert works(result_of(lambda wrapper=wrapper, env=env: wrapper(env, 2, exclude=value)))


@SETTINGS
@given(value=junk)
def test_reset_options_of_junk(wrist, value):
    for env in (ArmscanEnv([wrist]), ArmscanVectorEnv(2, [wrist])):
        assert is_answered(lambda env=env: env.reset(options=value))
        assert is_answered(lambda env=env: env.reset(options={"volume": value}))
        assert is_answered(lambda env=env: env.reset(options={"reset_mask": value}))


@SETTINGS
@given(value=junk)
def test_reset_seeds_of_junk(wrist, value):
    for env, seed in ((ArmscanEnv([wrist]), value), (ArmscanVectorEnv(1, [wrist]), [value])):
        assert is_answered(lambda env=env, seed=seed: env.reset(seed=seed))
        # Accepted or refused, the environment still works.
        assert env.observation_space.contains(env.reset(seed=1)[0])
    assert is_answered(lambda: ArmscanVectorEnv(2, [wrist]).reset(seed=value))


@SETTINGS
@given(value=junk | st.lists(st.floats(), min_size=1, max_size=2))
def test_actions_of_junk(wrist, value):
    for env, batch in ((ArmscanEnv([wrist], projection="zy"), value), (ArmscanVectorEnv(1, [wrist]), [value])):
        env.reset(seed=0)
        step = result_of(lambda env=env, batch=batch: env.step(batch))
        if step is not None:
            assert np.isfinite(step[1]).all()
            assert (np.abs(step[4]["action"]) <= 1.0).all()


@pytest.mark.parametrize(
    "wrong", [["0.5", "0"], np.array([1j, 0]), [b"1", b"0"], [10**400, 0], [[0.0], 0.0], {0.0, 1.0}]
)
def test_actions_that_are_no_numbers_are_refused(wrist, wrong):
    env = ArmscanEnv([wrist], projection="zy")
    env.reset(seed=0)
    with pytest.raises(InvalidValueError, match="action is"):
        env.step(wrong)


class Anything:
    """A reward that takes every plane as solved."""

    def fit(self, volumes, tissues):
        return self

    def score(self, landmarks, pixel_mm):
        return 0.0


OBSERVATIONS = {
    "action_reward": "action_reward",
    "cluster": "cluster",
    "cluster_raw": ClusterObservation(normalised=False),
    "slice": "slice",
    "slice_channels": "slice_channels",
    "slice_reduced": SliceObservation(shape=(5, 4)),
    "slice_metric": "slice_metric",
}


@pytest.mark.parametrize("observation", OBSERVATIONS.values(), ids=OBSERVATIONS)
def test_a_plane_wholly_outside_shows_nothing(wrist, observation):
    env = ArmscanEnv([wrist], observation=observation, flat=False, translation_bounds_mm=(1e6, 1e6), projection="full")
    env.reset(seed=0)
    observed, reward, terminated, _, info = env.step(np.array([0.3, 0.1, 1.0, 1.0]))
    assert (reward, terminated, info["counts"].tolist()) == (-1.0, False, [0, 0, 0])
    assert not env.slice_xz.any()
    assert env.observation_space.contains(observed)
    assert not any(part.any() for name, part in observed.items() if name not in ("action", "reward"))


@pytest.mark.parametrize("observation", OBSERVATIONS.values(), ids=OBSERVATIONS)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_volume_of_one_voxels_thickness_is_played_on(axis, observation):
    """Along the arm it is the only plane; a plane beside it is empty."""
    shape = [7, 9, 8]
    shape[axis] = 1
    labels = np.arange(np.prod(shape)).reshape(shape) % 4
    volume = LabelVolume(labels, (0.5, 0.6, 0.7), "thin", ManipulatorAction((0.0, 0.0), (0.0, 0.0)))
    env = ArmscanEnv([volume], observation=observation, reward=Anything(), projection="y", transform=None)
    observed, _ = env.reset(seed=0)
    assert env.observation_space.contains(observed)
    observed, *_ = env.step(np.array([-1.0]))
    assert env.observation_space.contains(observed)
    np.testing.assert_array_equal(env.slice_xz, labels[:, 0])
    assert not volume.slice(ManipulatorAction((0.0, 0.0), (0.0, 30.0))).any()
    with pytest.raises(OptimalPlaneError, match="thin: the labelled plane scores -"):
        ArmscanEnv([volume], transform=None)


def test_volumes_that_were_pickled_play_beside_others(wrist):
    """To Numba, read-only arrays have another type than writable ones."""
    copy = pickle.loads(pickle.dumps(wrist))
    assert not copy.labels.flags.writeable
    assert copy.labels_yxz.flags.c_contiguous
    other = LabelVolume(wrist.labels, wrist.spacing, "other", wrist.optimal_action)
    assert works(ArmscanVectorEnv(2, [copy, other]))


@SETTINGS
@given(value=junk)
def test_slices_with_junk(tiny_volume, value):
    plane = ManipulatorAction((0.0, 0.0), (0.0, 0.0))
    assert result_of(lambda: tiny_volume.slice(value)) is None
    assert is_answered(lambda: tiny_volume.slice(plane, value))
    assert is_answered(lambda: tiny_volume.slice(plane, transform=value))


@SETTINGS
@given(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 11))
def test_slices_of_far_away_planes(tiny_volume, numbers):
    plane = ManipulatorAction(numbers[:2], numbers[2:4])
    transform = result_of(lambda: RigidTransform(numbers[4:6], numbers[6:8], numbers[8:]))
    for slice_xz in (tiny_volume.slice(plane), tiny_volume.slice(plane, transform=transform)):
        assert slice_xz.shape == tiny_volume.slice_shape
        assert slice_xz.max() <= tiny_volume.labels.max()
