"""Networks: the observations they take, and their layers."""

import numpy as np
import pytest
import torch
from gymnasium import spaces

from armscan.agents import MLP, SAC, Compute, Multimodal, NetworkByObservation
from armscan.agents.convolutions import smallest_side_px
from armscan.envs import EnvFactory, SliceChannelsObservation, SliceObservation
from armscan.errors import InvalidValueError
from tests.agents.conftest import SMALL_MULTIMODAL, SMALL_SAC, setup_for

BY_OBSERVATION = NetworkByObservation(vector=MLP((8,)), images=SMALL_MULTIMODAL)


def space_of(phantom, observation, **rules):
    return EnvFactory(observation=observation, projection="zy", **rules).make_env([phantom]).observation_space


@pytest.mark.parametrize(
    ("observation", "rules", "kind"),
    [
        ("cluster", {}, MLP),
        ("action_reward", {"stack": 8, "memory": 4}, MLP),
        ("slice", {}, Multimodal),
        ("slice_channels", {"stack": 4, "memory": 2}, Multimodal),
        (["cluster", "slice"], {"stack": 3, "stack_exclude": ["clusters"]}, Multimodal),
        ("slice", {"flat": True}, MLP),
    ],
)
def test_network_is_chosen_from_the_observation(phantom, observation, rules, kind):
    assert isinstance(BY_OBSERVATION.for_space(space_of(phantom, observation, **rules)), kind)


def test_mlp_refuses_images(phantom):
    with pytest.raises(InvalidValueError, match=r"mlp, which takes one vector, but .* action, reward, slice; set net"):
        MLP((8,)).for_space(space_of(phantom, "slice"))


def test_multimodal_refuses_vectors(phantom):
    with pytest.raises(InvalidValueError, match=r"multimodal, which takes images, but the observation has none"):
        Multimodal().for_space(space_of(phantom, "cluster"))


@pytest.mark.parametrize("shape", [(35, 36), (36, 35)])
def test_multimodal_refuses_images_too_small_with_the_smallest_size_that_works(phantom, shape):
    space = space_of(phantom, SliceObservation(shape=shape))
    with pytest.raises(InvalidValueError, match=r"slice is 3\d x 3\d pixels, but .* need at least 36 x 36"):
        Multimodal().for_space(space)


@pytest.mark.parametrize(
    ("network", "observation"),
    [
        (MLP((16384, 16384)), "cluster"),
        (Multimodal(head_sizes=(16384,)), "slice"),
        (Multimodal(filters=(32, 4096, 4096)), SliceObservation(shape=(36, 36))),
        (NetworkByObservation(vector=MLP((8192, 8193)), images=Multimodal()), "cluster"),
    ],
    ids=["mlp", "head", "filters", "by_observation"],
)
def test_network_of_too_many_weights_is_refused_before_it_is_made(phantom, network, observation):
    with pytest.raises(
        InvalidValueError, match=r"network is m\w+ with \d+ weights, but there must be at most 67108864"
    ):
        network.for_space(space_of(phantom, observation))


def test_smallest_side_leaves_one_pixel_and_one_less_leaves_none():
    side = smallest_side_px()
    layers = [torch.nn.Conv2d(1, 1, kernel, stride) for kernel, stride in ((8, 4), (4, 2), (3, 1))]
    assert torch.nn.Sequential(*layers)(torch.zeros(1, 1, side, side)).shape == (1, 1, 1, 1)
    with pytest.raises(RuntimeError):
        torch.nn.Sequential(*layers)(torch.zeros(1, 1, side - 1, side))


def test_multimodal_is_the_published_network():
    boxes = {
        "action": spaces.Box(-1, 1, (4, 2)),
        "channels": spaces.Box(0, 1, (4, 3, 84, 84), np.uint8),
        "memory": spaces.Box(-1, 1, (6,)),
        "reward": spaces.Box(-1, 0, (4, 1)),
    }
    body = Multimodal().body(spaces.Dict(boxes), n_action=2)
    shapes = [tuple(layer.weight.shape) for layer in body.modules() if hasattr(layer, "weight")]
    assert shapes[:3] == [(32, 12, 8, 8), (64, 32, 4, 4), (64, 64, 3, 3)]
    # Stacked actions and rewards, the memory, and the action that a critic judges.
    assert shapes[3:] == [(512, 4 * 2 + 6 + 4 + 2), (512, 512), (512, 64 * 7 * 7 + 512), (512, 512)]


def test_multimodal_brings_labels_to_0_to_1(phantom):
    space = space_of(phantom, SliceObservation(shape=(36, 36)))
    body = SMALL_MULTIMODAL.body(space)
    seen = []
    body.convolutions["slice"].register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    observation = {name: np.repeat(box.high[None], 5, axis=0) for name, box in space.items()}
    body(observation)
    assert seen[0].shape == (5, 1, 36, 36)
    assert seen[0].unique().tolist() == [1.0]
    # Batches may have any size.
    assert body({name: images[:0] for name, images in observation.items()})[0].shape[0] == 0


@pytest.mark.parametrize(
    ("kind", "key", "value"),
    [
        *((MLP, "hidden_sizes", sizes) for sizes in ((0,), (16385,), "64", 64)),
        (MLP, "activation", "step"),
        (Multimodal, "filters", (1, 2)),
        (Multimodal, "vector_sizes", (0,)),
        (Multimodal, "head_sizes", "512"),
    ],
)
def test_network_refuses_impossible_layers(kind, key, value):
    with pytest.raises(InvalidValueError, match=f"network.{key} is"):
        kind(**{key: value})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"device": "tpu"}, "device is 'tpu', but it must be auto, cpu or cuda"),
        ({"precision": "float8"}, "precision is 'float8', but it must be float32 or bfloat16"),
        ({"compile": "maybe"}, "compile is 'maybe'"),
    ],
)
def test_compute_names_what_there_is(arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        Compute(**arguments)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_compute_without_a_gpu_takes_the_cpu_and_says_so_where_one_was_asked_for():
    assert Compute("auto").torch_device == "cpu"
    with pytest.raises(InvalidValueError, match="torch finds no CUDA device here"):
        Compute("cuda")


@pytest.mark.parametrize(
    ("device", "observation", "expected"),
    [("auto", "slice", "cuda"), ("auto", "cluster", "cpu"), ("cuda", "cluster", "cuda"), ("cpu", "slice", "cpu")],
)
def test_auto_takes_a_gpu_only_for_images(phantom, monkeypatch, device, observation, expected):
    monkeypatch.setattr("armscan.agents.compute._has_cuda", lambda: True)
    assert Compute(device).for_space(space_of(phantom, observation)).torch_device == expected


@pytest.mark.parametrize(
    "compute", [Compute("cpu", "bfloat16"), pytest.param(Compute("cpu", compile=True), marks=pytest.mark.slow)]
)
def test_learner_learns_with_every_way_of_computing(phantom, compute):
    env_factory = EnvFactory(projection="zy", observation=SliceChannelsObservation(shape=(36, 36)))
    learner = SAC(network=SMALL_MULTIMODAL, **SMALL_SAC).agent(setup_for(env_factory, phantom, compute=compute))
    learner.warm_up()
    metrics = learner.learn(40)
    assert np.isfinite(metrics["update/critic_loss"])
    env = env_factory.make_env([phantom])
    assert env.action_space.contains(learner.act(env.reset(seed=0)[0], -1.0))
