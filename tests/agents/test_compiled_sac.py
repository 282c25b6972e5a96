"""The compiled update of SAC, compared with Tianshou's own."""

import hashlib
import math
import os
from copy import deepcopy

import numpy as np
import pytest
import torch
from gymnasium import spaces
from tianshou.algorithm.modelfree import sac
from tianshou.algorithm.optim import AdamOptimizerFactory, RMSpropOptimizerFactory
from tianshou.data import Batch, PrioritizedVectorReplayBuffer
from tianshou.utils.torch_utils import policy_within_training_step

from armscan.agents import MLP, SAC, Compute, Multimodal
from armscan.agents.compiled_sac import N_AT_ONCE, CompiledSAC, fallback_reason
from armscan.agents.replay import Replay
from tests.agents.conftest import ENV_FACTORIES, SMALL_SAC, setup_for
from tests.support.programs import output_of
from tests.support.tensors import assert_same_tensors, named_tensors

# One worker compiles the update, which takes ten seconds, and the others find it on disk.
pytestmark = pytest.mark.xdist_group("compiled_sac")

N_ENVS, N_STEPS = 3, 40


def filled_replay(n_obs, n_action, kind=Replay, **arguments):
    """Return a buffer whose rings are filled to different lengths, with rewards and ends."""
    rng = np.random.default_rng(4)
    replay = kind(N_ENVS * N_STEPS, N_ENVS, **arguments)
    for step in range(N_STEPS // 2):
        ids = np.arange(N_ENVS if step < 10 else 2)
        shape = (len(ids), n_obs)
        replay.add(
            Batch(
                obs=rng.normal(size=shape).astype(np.float32),
                obs_next=rng.normal(size=shape).astype(np.float32),
                act=rng.uniform(-1, 1, (len(ids), n_action)).astype(np.float32),
                rew=rng.normal(size=len(ids)),
                terminated=rng.random(len(ids)) < 0.2,
                truncated=rng.random(len(ids)) < 0.1,
                info=Batch(),
            ),
            buffer_ids=ids,
        )
    return replay


def algorithm(kind, *, n_obs=5, n_action=2, hidden_sizes=(16, 16), activation="relu", alpha=None, **arguments):
    torch.manual_seed(0)
    space, network = spaces.Box(-10, 10, (n_obs,)), MLP(hidden_sizes, activation)
    policy = sac.SACPolicy(
        actor=network.actor(space, n_action, log_std=None),
        action_space=spaces.Box(-1, 1, (n_action,)),
        observation_space=space,
    )
    return kind(
        policy=policy,
        policy_optim=arguments.pop("policy_optim", AdamOptimizerFactory(lr=1e-3)),
        critic=network.critic(space, n_action),
        critic_optim=AdamOptimizerFactory(lr=2e-3),
        critic2=network.critic(space, n_action),
        tau=0.01,
        gamma=0.9,
        alpha=alpha or sac.AutoAlpha(-float(n_action), math.log(0.1), AdamOptimizerFactory(lr=1e-2)),
        **arguments,
    )


def compiled(replay, compute=None, **arguments):
    return algorithm(CompiledSAC, compute=compute or Compute("cpu"), replay=replay, **arguments)


def updated(each, replay, n, *, batch_size=32, seed=1, at_once=1):
    """Return the statistics of n gradient steps, as means over the steps taken at once."""
    replay.seed(seed)
    torch.manual_seed(seed)
    with policy_within_training_step(each.policy):
        if at_once == 1:
            return [each.update(replay, batch_size).get_loss_stats_dict() for _ in range(n)]
        return [each.update_repeatedly(replay, batch_size, at_once).get_loss_stats_dict() for _ in range(n // at_once)]


def assert_same_state(one, other, tolerance):
    assert_same_tensors(*([each.state_dict(), entropy_state(each)] for each in (one, other)), tolerance)


def differences(one, other):
    pairs = zip(one.parameters(), other.parameters(), strict=True)
    return np.concatenate([(a - b).detach().abs().numpy().ravel() for a, b in pairs])


def hand_over(source, target):
    """Load the state of one algorithm into another, as a checkpoint does."""
    if isinstance(source.alpha, sac.AutoAlpha):
        target.alpha._optim.load_state_dict(deepcopy(source.alpha._optim.state_dict()))
    target.load_state_dict(deepcopy(source.state_dict()))


def entropy_state(each):
    return each.alpha._optim.state_dict() if isinstance(each.alpha, sac.AutoAlpha) else {}


@pytest.mark.parametrize(
    ("hidden_sizes", "n_obs", "n_action", "batch_size", "alpha"),
    [
        ([16, 16], 5, 2, 32, None),
        ([16, 16], 5, 2, 32, 0.2),
        ([64, 64], 14, 1, 64, None),
        ([8], 1, 1, 1, None),
        ([33, 24], 9, 4, 7, None),
        ([24, 16, 33, 8], 7, 3, 32, None),
        ([1], 3, 2, 16, 0.05),
    ],
)
def test_compiled_updates_agree_with_those_of_tianshou(hidden_sizes, n_obs, n_action, batch_size, alpha):
    shape = {"hidden_sizes": hidden_sizes, "n_obs": n_obs, "n_action": n_action, "alpha": alpha}
    replay = filled_replay(n_obs, n_action)
    ours, theirs = compiled(replay, **shape), algorithm(sac.SAC, **shape)
    assert ours.fallback_reason is None
    for seed in range(10):
        ten, their_ten = (updated(each, replay, 10, batch_size=batch_size, seed=seed) for each in (ours, theirs))
        for one, other in zip(ten, their_ten, strict=True):
            assert one.pop("gradient_steps") == 1
            assert one.keys() == other.keys()
            np.testing.assert_allclose(list(one.values()), list(other.values()), rtol=1e-4, atol=1e-4)
        # Adam turns the rounding error of a zero gradient into a full step, so that single weights differ by more.
        assert np.quantile(differences(ours, theirs), 0.99) < 1e-4
        assert_same_state(ours, theirs, 5e-3)
        # Otherwise the differences would grow, as between any two trainings.
        hand_over(theirs, ours)


def test_denormal_averages_of_dead_units_become_zero():
    replay = filled_replay(n_obs=5, n_action=2)
    ours = compiled(replay, hidden_sizes=[16, 16])
    actor, n_weights = ours._agent().actor, 5 * 16
    actor.values[n_weights] = -1e6  # The bias of the first unit
    actor.exp_avg[:5] = 1e-40
    updated(ours, replay, 1)
    assert (actor.exp_avg[:5] == 0.0).all()
    assert np.float32(1e-40) * np.float32(0.5) > 0.0, "only the update flushes them"


def test_hundred_updates_at_the_default_size_agree_with_those_of_tianshou():
    shape = {"hidden_sizes": [64, 64], "n_obs": 14, "n_action": 1}
    replay = filled_replay(14, 1)
    ours, theirs = compiled(replay, **shape), algorithm(sac.SAC, **shape)
    for each in (ours, theirs):
        updated(each, replay, 100, batch_size=64)
    assert np.quantile(differences(ours, theirs), 0.99) < 1e-4


@pytest.mark.parametrize("at_once", [2, N_AT_ONCE + 3])
def test_updates_at_once_are_those_one_by_one_to_the_bit(at_once):
    replay = filled_replay(5, 2)
    one_by_one, at_once_too = compiled(replay), compiled(replay)
    single = updated(one_by_one, replay, 2 * at_once)
    several = updated(at_once_too, replay, 2 * at_once, at_once=at_once)
    assert [each["gradient_steps"] for each in several] == [at_once] * 2
    for name in ("actor_loss", "critic1_loss", "critic2_loss", "alpha", "alpha_loss"):
        means = np.mean([each[name] for each in single[:at_once]])
        np.testing.assert_allclose(several[0][name], means, rtol=1e-12)
    assert_same_state(one_by_one, at_once_too, 0.0)


# Updates on the given number of threads, and prints the digest of all weights and of Adam's state.
THREADS = """
import sys, torch
from tests.agents.test_compiled_sac import *
# The initial weights come from LAPACK, which a learner runs on one thread.
torch.set_num_threads(1)
replay = filled_replay(14, 1)
ours = compiled(replay, hidden_sizes=[64, 64], n_obs=14, n_action=1)
torch.set_num_threads(int(sys.argv[1]))
updated(ours, replay, 20, batch_size=256, at_once=4)
print(digest(ours))
"""


def digest(each):
    state = named_tensors([each.state_dict(), entropy_state(each)]).values()
    return hashlib.sha256(b"".join(part.numpy().tobytes() for part in state)).hexdigest()


def test_updates_are_the_same_to_the_bit_on_any_number_of_threads():
    """Products of 256 x 64 x 64 are large enough for BLAS to split them between threads."""
    digests = set()
    for n in ("1", "2"):
        limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), n)
        digests.add(output_of(THREADS, n, **limits).split()[-1])
    assert len(digests) == 1


def test_fork_goes_on_with_updates_that_its_parent_has_begun():
    replay = filled_replay(5, 2)
    ours = compiled(replay)
    updated(ours, replay, 4, at_once=2)
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        # Exits without pytest's teardown, even after an error.
        try:
            updated(ours, replay, 4, seed=2, at_once=2)
            os.write(writer, digest(ours).encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as file:
        of_child = file.read()
    assert os.waitpid(child, 0)[1] == 0
    before = digest(ours)
    updated(ours, replay, 4, seed=2, at_once=2)
    assert of_child == digest(ours) != before


def test_either_update_goes_on_from_the_others_state():
    replay = filled_replay(5, 2)
    ours, theirs, mixed = compiled(replay), algorithm(sac.SAC), compiled(replay)
    for k in range(3):
        for each in (ours, theirs):
            updated(each, replay, 10, seed=k)
        mixed.fallback_reason = "every other time" if k == 1 else None
        updated(mixed, replay, 10, seed=k)
    assert_same_state(ours, theirs, 1e-3)
    assert_same_state(mixed, theirs, 1e-3)
    into_theirs, into_ours = algorithm(sac.SAC), compiled(replay)
    for source, target in ((ours, into_theirs), (theirs, into_ours)):
        hand_over(source, target)
        assert_same_state(source, target, 0.0)
        updated(target, replay, 10, seed=9)
        updated(source, replay, 10, seed=9)
        assert_same_state(source, target, 1e-3)


def test_loading_a_state_from_before_the_first_update_begins_anew():
    replay = filled_replay(5, 2)
    ours, theirs = compiled(replay), algorithm(sac.SAC)
    fresh = deepcopy(theirs.state_dict())
    entropy = deepcopy(theirs.alpha._optim.state_dict())
    updated(ours, replay, 5)
    ours.load_state_dict(fresh)
    ours.alpha._optim.load_state_dict(entropy)
    for each in (ours, theirs):
        updated(each, replay, 5)
    assert_same_state(ours, theirs, 1e-3)


def test_weights_that_are_not_finite_are_not_hidden():
    replay = filled_replay(5, 2)
    ours = compiled(replay)
    ours.policy.actor.preprocess.model.model[0].weight.data[0, 0] = float("nan")
    updated(ours, replay, 1)
    assert not all(bool(torch.isfinite(part).all()) for part in ours.critic.parameters())


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"activation": "tanh"}, "its networks are not fully connected with ReLU"),
        ({"compute": Compute("cpu", "bfloat16")}, "it computes with bfloat16 on cpu"),
        ({"compute": Compute("cpu", compile=True)}, "compute.compile=true"),
        ({"n_step_return_horizon": 3}, "its returns look 3 steps ahead"),
        ({"policy_optim": RMSpropOptimizerFactory()}, "its optimisers are not plain Adam"),
        ({"policy_optim": AdamOptimizerFactory(weight_decay=0.1)}, "its optimisers are not plain Adam"),
    ],
)
def test_anything_else_is_left_to_tianshou(changes, reason):
    ours = compiled(filled_replay(5, 2), **changes)
    assert ours.fallback_reason == reason


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda layer: layer.requires_grad_(requires_grad=False), "a network has weights that are not trained"),
        (lambda layer: layer.register_forward_hook(lambda *_: None), "its networks are not fully connected with ReLU"),
        (lambda layer: layer.weight.register_hook(lambda _: None), "its networks are not fully connected with ReLU"),
        (
            lambda layer: layer.weight.register_post_accumulate_grad_hook(lambda _: None),
            "its networks are not fully connected with ReLU",
        ),
    ],
)
def test_networks_with_frozen_weights_or_hooks_are_left_to_tianshou(change, reason):
    replay = filled_replay(5, 2)
    ours = compiled(replay)
    change(ours.policy.actor.preprocess.model.model[0])
    assert fallback_reason(ours, Compute("cpu"), replay) == reason


def test_networks_with_shared_weights_are_left_to_tianshou():
    replay = filled_replay(5, 2)
    ours = compiled(replay)
    ours.policy.actor.sigma.model[0].weight = ours.policy.actor.mu.model[0].weight
    assert fallback_reason(ours, Compute("cpu"), replay) == "its networks are not fully connected with ReLU"


def test_other_replay_buffers_are_left_to_tianshou():
    replay = filled_replay(5, 2, PrioritizedVectorReplayBuffer, alpha=0.6, beta=0.4)
    ours = compiled(replay)
    assert ours.fallback_reason == "its replay buffer is PrioritizedVectorReplayBuffer"
    with policy_within_training_step(ours.policy):
        assert type(ours.update(replay, 8)) is sac.SACTrainingStats


def test_learner_says_how_it_computes_its_updates(phantom):
    notes = []
    for name, network in (("vector", MLP((8,))), ("vector", MLP((8,), "elu")), ("images", ENV_FACTORIES["images"][1])):
        learner = SAC(network=network, **SMALL_SAC).agent(setup_for(ENV_FACTORIES[name][0], phantom))
        notes.append(learner.update_note)
    assert notes == ["compiled", *["Tianshou, because its networks are not fully connected with ReLU"] * 2]
    assert isinstance(ENV_FACTORIES["images"][1], Multimodal)


def test_every_transition_is_drawn_as_often_as_any_other():
    replay = filled_replay(5, 2)
    replay.seed(0)
    drawn = replay.sample_indices(50_000)
    assert set(drawn) == set(replay.sample_indices(0))
    counts = np.unique(drawn, return_counts=True)[1]
    assert counts.max() / counts.min() < 1.3
