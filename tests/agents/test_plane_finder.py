"""The agent that looks beside the plane."""

from copy import deepcopy
from functools import partial

import numpy as np
import pytest
import torch

from armscan.agents import Compute, Learner, PlaneFinder, ScheduledLearner
from armscan.agents.look_network import FinderModule
from armscan.agents.policy import batch_of
from armscan.agents.torch_export import export_program
from armscan.envs import EnvFactory, MetricSliceObservation, RandomTransform
from armscan.envs.actions import ActionBounds
from armscan.errors import CheckpointError, InvalidValueError
from armscan.training import evaluate
from armscan.training.episodes import play
from armscan.volumes import LabelVolume
from tests.agents.conftest import setup_for
from tests.support.tensors import assert_same_tensors

SMALL = {"num_envs": 4, "filters": (2, 2, 2), "hidden_sizes": (16,)}
NAMES = ("rz", "rx", "tx", "ty")
RULES = {
    "projection": "full",
    "observation": MetricSliceObservation(pixel_mm=(4.05, 2.2)),
    "ends": "on_budget",
    "max_steps": 3,
    "stack": 3,
    "rotation_bounds_deg": (90.0, 45.0),
    "success_threshold": 0.5,
    "transform": RandomTransform(scale=0.05, shear=0.05),
}


def made(phantom, rules=None, **changes):
    env_factory = EnvFactory(**RULES | (rules or {}))
    names = (*NAMES, "stop") if (rules or {}).get("ends") == "on_stop" else NAMES
    validation = partial(env_factory.undeformed().make_vector_env, volumes=[phantom])
    setup = setup_for(env_factory, phantom, action_names=names, total_env_steps=480, make_validation_envs=validation)
    return PlaneFinder(**SMALL | changes).agent(setup), env_factory.make_env([phantom])


def played(learner, env, seed=0):
    """Return the planes of an episode, normalised, and whether its last step terminated it."""
    observation, info = env.reset(seed=seed)
    learner.begin(seed=seed, bounds=env.get_wrapper_attr("scene").bounds)
    actions, terminated, truncated = [info["action"]], False, False
    while not (terminated or truncated):
        actions.append(learner.act(observation, 0.0))
        observation, _, terminated, truncated, _ = env.step(actions[-1])
    return np.array(actions), terminated


def test_learner_takes_its_steps_and_its_loss_falls(phantom):
    learner, _ = made(phantom, lr=2e-2, lr_end_factor=1.0)
    assert isinstance(learner, Learner)
    learner.warm_up()
    losses = [learner.learn(240)["update/loss"] for _ in range(3)]
    assert learner.n_env_steps == 3 * 240
    assert learner.env_steps_at_once == 12
    assert losses[-1] < 0.7 * losses[0]


def test_learner_goes_on_from_its_state_to_the_bit(phantom):
    one, other = made(phantom)[0], made(phantom)[0]
    one.learn(24)
    other.load_state(deepcopy(one.state()))
    for learner in (one, other):
        learner.learn(24)
    assert one.n_env_steps == other.n_env_steps == 48
    assert_same_tensors(one.weights(), other.weights())


def test_looks_lie_beside_what_is_found_and_the_last_on_it(phantom):
    """The looks of a network that always predicts 2 mm ahead without tilt are known."""
    learner, env = made(phantom)
    learner.load_weights(
        {name: torch.zeros_like(w) if "place." in name else w for name, w in learner.weights().items()}
    )
    learner.load_weights(learner.weights() | {"network.place.bias": torch.tensor([0.0, 0.0, 2.0 / 3.0, 0.0])})
    actions, _ = played(learner, env)
    geometry = learner.policy().actor.geometry
    planes = geometry.planes(torch.as_tensor(actions, dtype=torch.float32))
    way = [(geometry.middles(planes)[i + 1] - geometry.middles(planes)[i])[1].item() for i in range(3)]
    assert way == pytest.approx([2.0 + 9.0, 2.0 - 9.0, 2.0], abs=1e-3)
    np.testing.assert_allclose(planes[:, :2], 0.0, atol=1e-3)


def assert_policy_answers(learner, env):
    """Check that the policy, and the program exported from it, answer the same looks as the learner does."""
    observations = []
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        for _ in range(3):
            observations.append(observation)
            observation = env.step(learner.act(observation, 0.0))[0]
    batch = batch_of(observations)
    actions = np.array([learner.act(observation, 0.0) for observation in observations])
    policy = learner.policy()
    for answers in (policy(batch), export_program(policy, batch).module()(batch)):
        np.testing.assert_allclose(answers, actions, atol=1e-6)


@pytest.mark.parametrize(("n_averaged", "average_tilts"), [(1, True), (2, True), (2, False)])
def test_policy_answers_as_the_learner_does_also_exported(phantom, n_averaged, average_tilts):
    learner, env = made(phantom, n_averaged=n_averaged, average_tilts=average_tilts)
    learner.learn(24)
    assert_policy_answers(learner, env)
    assert learner.policy().differs is None


@pytest.mark.parametrize("average_tilts", [True, False])
def test_place_is_averaged_over_the_estimates_of_the_latest_looks(phantom, average_tilts):
    learner, env = made(phantom, n_averaged=2, average_tilts=average_tilts)
    learner.learn(24)
    observation, _ = env.reset(seed=0)
    learner.begin(seed=0, bounds=env.get_wrapper_attr("scene").bounds)
    module, planes, weights = learner._module, [], []
    geometry = module.geometry
    for _ in range(3):
        looks = learner._tensors(batch_of([observation]))
        with torch.no_grad():
            estimate, found = module.estimate(looks), module.found(looks)
        planes.append(geometry.from_frame(estimate.plane, estimate.place, torch.zeros(1)))
        weights.append(1.0 / estimate.expected[:, [1, 1, 0, 0]] ** 2)
        # After the first look there is one estimate alone.
        places = [geometry.seen_from(estimate.plane, plane) for plane in planes[-2:]]
        weighted = sum(weight * place for weight, place in zip(weights[-2:], places, strict=True))
        expected = weighted / sum(weights[-2:])
        if not average_tilts:
            expected[:, :2] = estimate.place[:, :2]
        torch.testing.assert_close(found.place, expected, atol=1e-3, rtol=1e-3)
        observation = env.step(learner.act(observation, 0.0))[0]
    assert (found.place - estimate.place).abs().max() > 0.1


def test_each_look_knows_its_place_in_the_episode(phantom):
    learner, env = made(phantom)
    observation, _ = env.reset(seed=0)
    module = learner._module
    assert isinstance(module, FinderModule)
    for place in (0, 1, 2):
        step = module.estimate(learner._tensors(batch_of([observation]))).step
        assert step[0].tolist() == [float(i == place) for i in range(3)]
        observation = env.step(learner.act(observation, 0.0))[0]


@pytest.mark.parametrize(("sure", "n_steps"), [(None, 3), ((1e9, 1e9), 1), ((1e-9, 1e-9), 3)])
def test_learner_stops_when_it_is_sure_and_after_its_last_look(phantom, sure, n_steps):
    sure_mm, sure_deg = sure or (None, None)
    learner, env = made(phantom, {"ends": "on_stop", "max_steps": 10}, sure_mm=sure_mm, sure_deg=sure_deg)
    learner.learn(12)
    actions, terminated = played(learner, env)
    assert terminated
    assert len(actions) - 1 == n_steps
    assert (actions[1:, 4] > 0).tolist() == [False] * (n_steps - 1) + [True]


def test_episodes_side_by_side_are_those_played_one_by_one_with_what_was_expected(phantom):
    learner, env = made(phantom, {"ends": "on_stop", "max_steps": 3}, sure_mm=3.0, sure_deg=8.0)
    learner.learn(24)
    side_by_side = evaluate(learner, env, n_episodes=5, seed=7).episodes
    alone = tuple(play(learner, env, phantom.name, 7 + i) for i in range(5))
    assert side_by_side == alone
    assert len({each.expected_mm for each in alone}) > 1
    assert min(min(each.expected_mm, each.expected_deg) for each in alone) > 0.0


def test_errors_are_expected_with_a_schedule_too(phantom):
    learner, env = made(phantom)
    scheduled = ScheduledLearner(learner, [(48, made(phantom, lr=1e-4)[0])])
    scheduled.learn(48)
    scheduled.learn(48)
    for each in (play(scheduled, env, phantom.name, seed=3), *evaluate(scheduled, env, n_episodes=2, seed=3).episodes):
        assert each.expected_mm > 0.0
        assert each.expected_deg > 0.0


def test_expected_errors_are_right_on_average_even_where_the_agent_stops_early(phantom):
    size = {"num_envs": 16, "filters": (8, 8, 8), "hidden_sizes": (64,), "lr": 5e-3, "lr_end_factor": 1.0}
    learner, _ = made(phantom, {"ends": "on_stop"}, sure_mm=8.0, sure_deg=4.0, **size)
    learner.learn(9600)
    learner._further_metrics(seed=5)
    validation_env = EnvFactory(**RULES | {"ends": "on_stop"}).undeformed().make_env([phantom])
    episodes = evaluate(learner, validation_env, n_episodes=96, seed=5).episodes
    assert len({each.n_steps for each in episodes}) > 1
    for unit in ("mm", "deg"):
        expected, actual = ([getattr(each, f"{part}_{unit}") for each in episodes] for part in ("expected", "distance"))
        assert np.mean(expected) == pytest.approx(np.mean(actual), rel=0.05)


def test_expected_errors_are_right_on_average_where_they_were_calibrated(phantom):
    learner, _ = made(phantom)
    metrics = learner.learn(24)
    again = learner._further_metrics(seed=5)
    factors = [learner._further_metrics(seed=5)[f"calibration/factor_{unit}"] for unit in ("mm", "deg")]
    # On the same episodes there is nothing left to scale.
    assert factors == pytest.approx([again[f"calibration/factor_{unit}"] for unit in ("mm", "deg")], rel=1e-4)
    assert metrics["calibration/error_mm"] > 0.0
    assert learner.expected_error is None
    learner.act(made(phantom)[1].reset(seed=0)[0], 0.0)
    assert min(learner.expected_error) > 0.0


def test_calibration_changes_nothing_that_is_learned(phantom):
    learners = [made(phantom)[0] for _ in range(2)]
    learners[1]._module.calibration.mul_(3.0)
    weights = []
    for learner in learners:
        learner._calibration_envs = None
        learner.learn(48)
        weights.append(dict(learner._module.network.named_parameters()))
    for name, weight in weights[0].items():
        torch.testing.assert_close(weight, weights[1][name], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("share", [None, 0.0, 0.25, 1.0])
def test_phantoms_have_their_share_beside_other_volumes(phantom, share):
    wrist = LabelVolume(phantom.labels, phantom.spacing, "phantom-wrist.nrrd", phantom.optimal_action)
    envs = partial(EnvFactory(**RULES).make_vector_env, volumes=[phantom, wrist])
    setup = setup_for(EnvFactory(**RULES), phantom, action_names=NAMES, total_env_steps=480, make_envs=envs)
    learner = PlaneFinder(**SMALL | {"num_envs": 40}, phantom_share=share).agent(setup)
    drawn = learner._volumes(np.random.default_rng(0), 40)
    if share is None:
        assert drawn is None
    else:
        assert drawn["volume"].count("phantom-0") == pytest.approx(40 * share, abs=7)
        assert set(drawn["volume"]) <= {"phantom-0", "phantom-wrist.nrrd"}
    learner.learn(120)
    assert learner.n_env_steps == 120


def test_learner_learns_two_looks_and_five(phantom):
    for offsets in ((9.0, 0.0), (9, -9, 9, -9, 0)):
        n = len(offsets)
        learner, env = made(phantom, {"stack": n, "max_steps": n}, offsets_mm=offsets, n_seen=min(n, 3))
        learner.learn(n * 4)
        actions, _ = played(learner, env)
        assert len(actions) == n + 1


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"ends": "on_reward"}, "env.ends is 'on_reward'"),
        ({"max_steps": 2}, "env.max_steps is 2"),
        ({"stack": 2}, "2 are stacked .* take stack=3"),
        ({"observation": "slice_channels"}, "no part 'shares': take obs=slice_metric"),
        ({"stack_exclude": ["action"]}, "part 'action'"),
    ],
)
def test_environments_that_do_not_fit_are_refused(phantom, rules, message):
    with pytest.raises(InvalidValueError, match=message):
        made(phantom, rules)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"offsets_mm": (9.0, -9.0)}, r"agent.offsets_mm is \[9.0, -9.0\], but it must be .* the last of them 0"),
        ({"offsets_mm": (0.0,)}, "agent.offsets_mm is"),
        ({"offsets_mm": "wide"}, "agent.offsets_mm is"),
        ({"n_seen": 4}, "agent.n_seen is 4, but it must be at most 3"),
        ({"average_tilts": "no"}, "agent.average_tilts is 'no', but it must be true or false"),
        ({"n_averaged": 4}, "agent.n_averaged is 4, but it must be at most 3"),
        ({"sure_mm": 1.0}, "both or none"),
        ({"sure_mm": 1.0, "sure_deg": 2.0}, "agent.sure_mm is 1.0, but .* can only stop with env.ends=on_stop"),
        ({"filters": (2, 2)}, "agent.filters"),
        ({"lr": 0.0}, "agent.lr"),
        ({"phantom_share": 1.5}, "agent.phantom_share is 1.5"),
        ({"num_envs": 1000}, "agent.num_envs is 1000"),
    ],
)
def test_impossible_parameters_are_refused(phantom, changes, message):
    with pytest.raises(InvalidValueError, match=message):
        made(phantom, **changes)


def test_other_components_weights_and_bounds_are_refused(phantom):
    env_factory = EnvFactory(**RULES | {"projection": "zy"})
    with pytest.raises(InvalidValueError, match="take projection=full"):
        PlaneFinder(**SMALL).agent(setup_for(env_factory, phantom))
    learner, _ = made(phantom)
    with pytest.raises(CheckpointError):
        learner.load_weights({})
    with pytest.raises(InvalidValueError, match="give them with"):
        learner.begin(seed=0, bounds=ActionBounds((90.0, 45.0), (50.0, 300.0)))


def test_learner_computes_in_mixed_precision(phantom):
    env_factory = EnvFactory(**RULES)
    setup = setup_for(env_factory, phantom, action_names=NAMES, total_env_steps=480, compute=Compute("cpu", "bfloat16"))
    learner = PlaneFinder(**SMALL).agent(setup)
    computed = []
    learner._module.network.place.register_forward_hook(lambda _, inputs, output: computed.append(output.dtype))
    assert np.isfinite(learner.learn(24)["update/loss"])
    n_taught = len(computed)
    learner.act(env_factory.make_env([phantom]).reset(seed=0)[0], 0.0)
    # Learning and acting alike.
    assert 0 < n_taught < len(computed)
    assert set(computed) == {torch.bfloat16}


def test_places_of_earlier_looks_are_computed_in_32_bits_beside_mixed_precision(phantom):
    env_factory = EnvFactory(**RULES)
    setup = setup_for(env_factory, phantom, action_names=NAMES, total_env_steps=480, compute=Compute("cpu", "bfloat16"))
    module, seen = PlaneFinder(**SMALL).agent(setup)._module, []
    module.network.linear[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][:, -8:]))
    observation = env_factory.make_env([phantom]).reset(seed=0)[0]
    observation["action"] = np.random.default_rng(0).uniform(-0.1, 0.1, observation["action"].shape)
    module.estimate({name: part.float() for name, part in batch_of([observation]).items()})
    geometry = module.geometry.to("cpu", torch.float32)
    planes = geometry.planes(torch.as_tensor(observation["action"][None], dtype=torch.float32))
    torch.testing.assert_close(seen[0], module.network.earlier_places(planes, geometry))


def test_every_gradient_step_learns_from_episodes_of_its_own(phantom, monkeypatch):
    learner, _ = made(phantom)
    seen, gradient_step = [], learner._gradient_step

    def recorded(*arguments):
        seen.append(learner._optima(learner._envs))
        return gradient_step(*arguments)

    monkeypatch.setattr(learner, "_gradient_step", recorded)
    learner.learn(24)
    assert len(seen) > 1
    assert not torch.equal(seen[0], seen[1])


def test_learning_rate_comes_down_to_its_end(phantom):
    learner, _ = made(phantom, lr=1e-2, lr_end_factor=0.1)
    learner.learn(480)
    assert all(group["lr"] < 2e-3 for group in learner._lr_groups())
