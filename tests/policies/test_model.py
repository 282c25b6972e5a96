"""Policies as models: loaded without armscan, served over HTTP, and refused if they differ from the agent."""

import json
import os
import shutil
import signal
import subprocess
import sys
import urllib.request
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from mlflow.exceptions import MlflowException

from armscan.agents.policy import batch_of
from armscan.envs import ArmscanEnv
from armscan.errors import ExportError
from armscan.policies.build import facts_of, make_model, onnx_answers, save_policy
from armscan.policies.model import FILES, arrays_of, is_model, model_sha256, others_in
from armscan.tracking import TrackedRun, open_store
from armscan.training.episode_seeds import EXPORT_SEED
from tests.agents.conftest import ALGORITHMS, ENV_FACTORIES, setup_for
from tests.agents.test_plane_finder import made as made_finder
from tests.agents.test_policy import observed, taught
from tests.support.mlflow_server import is_answered
from tests.support.ports import LOOPBACK, free_port
from tests.support.waiting import HANG_S, wait_until

# They export seven policies and serve two of them.
pytestmark = pytest.mark.full

FINDER = ("plane_finder", "looks")
VARIANTS = [*((algorithm, made_of) for algorithm in ALGORITHMS for made_of in ENV_FACTORIES), FINDER]
# Loads each given model and asks it, for a batch of one and for all; prints which packages it has imported.
ASK = """
import sys, mlflow.pyfunc, numpy
for folder in sys.argv[1:]:
    model = mlflow.pyfunc.load_model(folder + "/model")
    with numpy.load(folder + "/observations.npz") as file:
        parts = dict(file)
    for n in (1, 7):
        some = {name: part[:n] for name, part in parts.items()}
        numpy.save(f"{folder}/answers_{n}.npy", model.predict(some.get("only", some)))
print([name for name in ("armscan", "tianshou", "gymnasium") if name in sys.modules])
"""


def learner_of(algorithm, made_of, phantom):
    if (algorithm, made_of) == FINDER:
        learner, env = made_finder(phantom, {"ends": "on_stop", "max_steps": 50}, sure_mm=1e9, sure_deg=10.0)
        learner.learn(24)
        return learner, env
    kind, small = ALGORITHMS[algorithm]
    env_factory, network = ENV_FACTORIES[made_of]
    return taught(kind(network=network, **small).agent(setup_for(env_factory, phantom))), env_factory.make_env(
        [phantom]
    )


@pytest.fixture(scope="module")
def made(phantom, tmp_path_factory):
    """Return, for each variant of learner, the folder of its model, observations, and its actions on them."""
    everything = {}
    for algorithm, made_of in VARIANTS:
        folder = tmp_path_factory.mktemp(f"{algorithm}-{made_of}")
        learner, env = learner_of(algorithm, made_of, phantom)
        make_model(learner, env, folder / "model", {"armscan": "0"})
        observations = observed(env)
        arrays = arrays_of(batch_of(observations))
        np.savez(folder / "observations.npz", **(arrays if isinstance(arrays, dict) else {"only": arrays}))
        everything[algorithm, made_of] = folder, arrays, np.array([learner.act(each, -0.1) for each in observations])
    return everything


def test_models_answer_in_a_fresh_process_without_armscan_as_the_learners_act(made):
    folders = [str(folder) for folder, _, _ in made.values()]
    asked = subprocess.run([sys.executable, "-c", ASK, *folders], capture_output=True, text=True, check=False)
    assert (asked.returncode, asked.stderr, asked.stdout.strip()) == (0, "", "[]")
    for variant, (folder, arrays, acted) in made.items():
        for n in (1, 7):
            answers = np.load(folder / f"answers_{n}.npy")
            np.testing.assert_allclose(answers, acted[:n], rtol=0, atol=1e-6, err_msg=str(variant))
        answers = onnx_answers(folder / "model" / "policy.onnx", arrays)
        np.testing.assert_allclose(answers, acted, rtol=0, atol=1e-5, err_msg=str(variant))


def test_model_says_what_goes_in_and_comes_out(made):
    folder, _, _ = made["ppo", "images"]
    said = yaml.safe_load((folder / "model" / "MLmodel").read_text())
    inputs = {each["name"]: each["tensor-spec"] for each in json.loads(said["signature"]["inputs"])}
    assert inputs["channels"] == {"dtype": "uint8", "shape": [-1, 2, 3, 36, 36]}
    assert {name for name, spec in inputs.items() if spec["dtype"] == "float32"} == {"action", "reward", "memory"}
    outputs = json.loads(said["signature"]["outputs"])
    assert outputs == [{"type": "tensor", "tensor-spec": {"dtype": "float32", "shape": [-1, 2]}}]
    requirements = (folder / "model" / "requirements.txt").read_text().split()
    assert [line.partition("==")[0] for line in requirements] == ["mlflow", "numpy", "torch"]
    assert "+" not in "".join(requirements)
    assert is_model(folder / "model")
    assert not is_model(folder)
    assert all((folder / "model" / file).is_file() for file in FILES)
    assert others_in(folder / "model") == []
    example = json.loads((folder / "model" / "serving_input_example.json").read_text())["inputs"]
    assert len(example["reward"]) == 2


def test_only_what_is_not_of_a_model_and_no_bytecode_is_in_the_way_of_a_new_one(tmp_path):
    files = [*FILES, "__pycache__/pyfunc.cpython-311.pyc", "notes/mine.txt"]
    for file in files:
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    assert others_in(tmp_path) == ["notes", "notes/mine.txt"]


def test_model_is_served_and_answers_over_http_as_the_learner_acts(made):
    variants = [("sac", "vector"), ("ppo", "images")]
    servers = [serve(made[variant][0] / "model") for variant in variants]
    try:
        for variant, (server, port, log) in zip(variants, servers, strict=True):
            _, arrays, acted = made[variant]
            ping = partial(is_answered, f"http://{LOOPBACK}:{port}/ping")
            wait_until(ping, process=server, log=log.read_text, poll_s=0.1)
            for n in (1, 7):
                parts = {name: part[:n].tolist() for name, part in arrays.items()} if isinstance(arrays, dict) else None
                given = {"inputs": parts or arrays[:n].tolist()}
                np.testing.assert_allclose(invoke(port, given), acted[:n], rtol=0, atol=1e-6)
    finally:
        for server, _, _ in servers:
            os.killpg(server.pid, signal.SIGTERM)
            server.wait(HANG_S)


def serve(model):
    port, log = free_port(), model.parent / "server.log"
    words = ["models", "serve", "-m", str(model), "--env-manager", "local", "-h", LOOPBACK, "-p", str(port)]
    bin_folder = Path(sys.executable).parent
    with log.open("wb") as said:
        # It looks for uvicorn on the path; in its own process group, so that its child processes are ended, too.
        server = subprocess.Popen(
            [bin_folder / "mlflow", *words],
            env=os.environ | {"PATH": f"{bin_folder}{os.pathsep}{os.environ['PATH']}"},
            stdout=said,
            stderr=said,
            start_new_session=True,
        )
    return server, port, log


def invoke(port, given):
    request = urllib.request.Request(
        f"http://{LOOPBACK}:{port}/invocations", json.dumps(given).encode(), {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=HANG_S) as answer:
        return np.array(json.loads(answer.read())["predictions"])


class Otherwise:
    """A learner whose actions differ from those of its policy."""

    def __init__(self, learner, shift):
        self._learner, self._shift = learner, shift

    def __getattr__(self, name):
        return getattr(self._learner, name)

    def act(self, observation, reward):
        return self._learner.act(observation, reward) * (1 + self._shift)


@pytest.fixture
def regression(phantom):
    return learner_of("regression", "vector", phantom)


def test_model_that_answers_otherwise_than_the_agent_is_not_written(regression, tmp_path):
    learner, env = regression
    make_model(learner, env, tmp_path / "model", {"armscan": "0"})
    before = (tmp_path / "model" / "MLmodel").read_bytes()
    refusal = r"the model differs from the agent by up to .*, but 1e-05 is allowed"
    with pytest.raises(ExportError, match=refusal):
        make_model(Otherwise(learner, 1e-3), env, tmp_path / "model", {"armscan": "0"})
    with pytest.raises(ExportError, match="up to nan, but"):
        make_model(Otherwise(learner, float("nan")), Unmoved(env), tmp_path / "model", {"armscan": "0"})
    assert [path.name for path in tmp_path.iterdir()] == ["model"]
    assert (tmp_path / "model" / "MLmodel").read_bytes() == before


class Unmoved:
    """An environment that shows its first plane after every action."""

    def __init__(self, env):
        self._env = env
        self._observation, self._info = env.reset(seed=EXPORT_SEED)

    def get_wrapper_attr(self, name):
        return self._env.get_wrapper_attr(name)

    def reset(self, **_):
        return self._observation, self._info

    def step(self, _):
        return self._observation, -0.1, False, False, self._info


def test_model_whose_place_cannot_be_written_to_is_named(regression, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ExportError, match=r"file/in/model: the model cannot be written \(Not a directory\)"):
        make_model(*regression, tmp_path / "file" / "in" / "model", {"armscan": "0"})


def test_error_of_a_library_is_one_line_but_an_interrupt_stays_one(regression, tmp_path, monkeypatch):
    def refuse(_):
        raise MlflowException("no\nsuch flavour")

    def interrupt(_):
        raise SystemError("compiled code") from KeyboardInterrupt()

    monkeypatch.setattr("mlflow.pyfunc.load_model", refuse)
    with pytest.raises(ExportError, match=r"^the model cannot be written or run: no such flavour$"):
        make_model(*regression, tmp_path / "model", {"armscan": "0"})
    monkeypatch.setattr("mlflow.pyfunc.load_model", interrupt)
    with pytest.raises(SystemError):
        make_model(*regression, tmp_path / "model", {"armscan": "0"})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("shift", "tag"), [(0.0, "kept"), (1e-3, "not kept: the model differs from the agent")])
def test_run_keeps_its_policy_or_says_why_not_and_finishes(regression, tmp_path, capsys, shift, tag):
    learner, env = regression
    store, experiment_id = open_store(
        f"sqlite:///{tmp_path}/runs.db", experiment="test", artifacts=str(tmp_path / "artifacts"), wait_s=60.0
    )
    folder = tmp_path / "run"
    folder.mkdir()
    rules = {"projection": "zy", "observation": ["cluster", "slice"], "stack": 1, "memory": 0}
    bounds = {"rotation_bounds_deg": [90.0, 45.0], "translation_bounds_mm": [40.0, 300.0]}
    config = {"tracking": {"uri": "-"}, "env": rules | bounds}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    with TrackedRun.start(store, experiment_id, name="n", config={}, tags={}, folder=folder) as tracked:
        save_policy(Otherwise(learner, shift), env, tracked, folder, print, slice_px=(90, 80))
    run = store.get_run(tracked.run_id)
    assert run.info.status == "FINISHED"
    assert run.data.tags["policy"].startswith(tag)
    assert (run.data.tags.get("policy.sha256") == model_sha256(folder / "policy")) == (tag == "kept")
    is_kept = tag == "kept"
    assert (folder / "policy").exists() == is_kept
    assert ("the policy is not kept as a model: the model differs" in capsys.readouterr().out) != is_kept
    assert [file.path for file in store.list_artifacts(tracked.run_id)] == (["policy"] if is_kept else [])
    if is_kept:
        kept = {file.path for file in store.list_artifacts(tracked.run_id, "policy")}
        assert {"policy/MLmodel", "policy/policy.onnx", "policy/artifacts"} <= kept
        said = yaml.safe_load((folder / "policy" / "MLmodel").read_text())["metadata"]
        assert said["run"] == tracked.run_id
        assert said["observation"][1]["crop"] == [90, 80]
        assert said["action"] == [
            {"component": "rz", "value": "a times 90.0 degrees"},
            {"component": "ty", "value": "(a + 1) / 2 times 300.0, in mm"},
        ]


def test_metadata_has_the_components_in_the_order_of_the_action(phantom, tmp_path):
    env = ArmscanEnv([phantom], projection="full", ends="on_stop")
    rules = {"observation": [], "rotation_bounds_deg": [90.0, 45.0], "translation_bounds_mm": None}
    facts = facts_of({"env": rules}, env, "0", (90, 80))
    learner, learners_env = learner_of(*VARIANTS[0], phantom)
    make_model(learner, learners_env, tmp_path / "model", facts)
    kept = yaml.safe_load((tmp_path / "model" / "MLmodel").read_text())["metadata"]["action"]
    assert [each["component"] for each in kept] == [*env.action_names] == ["rz", "rx", "tx", "ty", "stop"]


def test_run_keeps_no_policy_where_its_configuration_says_so(regression, tmp_path):
    (tmp_path / "config.yaml").write_text("tracking: {policy: false}")
    # The tracked run is not used.
    save_policy(*regression, None, tmp_path, print, slice_px=(90, 80))
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]


@pytest.mark.parametrize("value", [np.nan, 1e300])
def test_model_refuses_observations_that_give_no_finite_action(made, value):
    import mlflow.pyfunc

    folder, arrays, _ = made["sac", "vector"]
    model = mlflow.pyfunc.load_model(str(folder / "model"))
    with np.errstate(over="ignore"), pytest.raises(ValueError, match="actions that are not finite"):
        model.predict(np.full_like(arrays, value))


def test_model_with_a_damaged_weight_is_refused(made, tmp_path):
    import mlflow.pyfunc

    shutil.copytree(made["sac", "vector"][0] / "model", tmp_path / "model")
    program = tmp_path / "model" / "artifacts" / "policy.pt2"
    with zipfile.ZipFile(program) as archive:
        (weight, *_) = [each for each in archive.infolist() if "/weights/weight_" in each.filename]
    contents = bytearray(program.read_bytes())
    # After the entry's own header, whose name and padding are shorter than this.
    contents[weight.header_offset + weight.file_size] ^= 1
    program.write_bytes(contents)
    with pytest.raises(ValueError, match=r"policy\.pt2: the policy is damaged, in .*/weights/weight_"):
        mlflow.pyfunc.load_model(str(tmp_path / "model"))


def test_model_takes_memory_that_may_not_be_written_to(made):
    import mlflow.pyfunc

    folder, arrays, acted = made["sac", "vector"]
    arrays.flags.writeable = False
    with torch.inference_mode():
        answers = mlflow.pyfunc.load_model(str(folder / "model")).predict(arrays)
    np.testing.assert_allclose(answers, acted, rtol=0, atol=1e-6)
