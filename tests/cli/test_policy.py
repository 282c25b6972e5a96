"""The commands that export and register policies, as a user types them, on real tracked runs."""

import json
import shutil
from functools import partial

import mlflow.pyfunc
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from armscan.agents.policy import SAMPLING
from armscan.policies import build
from armscan.policies.build import SUM_TAG
from armscan.policies.model import model_sha256
from armscan.runs.model_card import MAX_CHARS
from armscan.tracking.tags import EVALUATED_TAG
from armscan.training import load_checkpoint, save_checkpoint
from armscan.utils.run_files import BEST_CHECKPOINT
from tests.support.refusals import assert_refused
from tests.support.tracked_runs import GUESSER, IMAGES, store_of, tracked
from tests.test_run import runs_in
from tests.training.test_train import evaluation_of

EXPORT, REGISTER = ("export", "--out=new"), ("register", "--name=n")


@pytest.fixture
def answer(armscan, tmp_path, monkeypatch, database):
    """Run `armscan policy`; return its exit code and what it printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", database)
    return partial(armscan, "policy")


@pytest.mark.parametrize(
    "words", [["projection=zy", "agent.deterministic_eval=false", "compute.precision=bfloat16"], ["obs=slice", *IMAGES]]
)
def test_policy_of_an_earlier_run_is_exported_from_its_checkpoint(answer, tmp_path, words):
    run_id = tracked(tmp_path, *words)
    assert answer("export", run_id[:8], "--out=models/mine") == (
        0,
        "exported   models/mine\n"
        "load it    mlflow.pyfunc.load_model('models/mine').predict(observations)\n"
        "serve it   mlflow models serve -m models/mine --env-manager local\n",
        "",
    )
    model = mlflow.pyfunc.load_model("models/mine")
    answers = model.predict(model.input_example)
    assert answers.shape == (2, 2 if "projection=zy" in words else 1)
    assert np.abs(answers).max() <= 1
    said = model.metadata.metadata
    # As the network itself answers, with all of its bits; the run's figures are those of sampled actions.
    differs = SAMPLING if "agent.deterministic_eval=false" in words else None
    assert (said["run"], said["differs_from_agent"]) == (run_id, differs)
    assert (tmp_path / "models" / "mine" / "policy.onnx").stat().st_size > 1000
    # A model of ours is replaced.
    assert answer("export", run_id, "--out=models/mine")[0] == 0
    assert [path.name for path in (tmp_path / "models").iterdir()] == ["mine"]
    # What else lies in its folder is not.
    (tmp_path / "models" / "mine" / "notes.txt").write_text("precious")
    assert answer("export", run_id, "--out=models/mine") == (
        2,
        "",
        "error: --out is 'models/mine', but 'notes.txt' is in it, and would be lost: name another",
    )
    assert (tmp_path / "models" / "mine" / "notes.txt").read_text() == "precious"


def test_policy_is_registered_with_the_figures_of_its_run(answer, armscan, tmp_path):
    run_id = tracked(tmp_path)
    code, printed, errors = answer("register", run_id, "--name=wrist plane")
    assert (code, errors) == (0, "")
    assert printed.splitlines() == [
        "registered models:/wrist plane/1",
        f"its store  export MLFLOW_TRACKING_URI=sqlite:///{tmp_path}/mlruns.db",
        "load it    mlflow.pyfunc.load_model('models:/wrist plane/1').predict(observations)",
        "serve it   mlflow models serve -m 'models:/wrist plane/1' --env-manager local",
    ]
    client = store_of(tmp_path)
    first = client.get_model_version("wrist plane", "1")
    assert first.run_id == run_id
    # The version and the model of the run's best checkpoint name each other.
    (model,) = client.search_logged_models([client.get_run(run_id).info.experiment_id])
    assert first.tags == {"logged_model": model.model_id}
    assert json.loads(model.tags["mlflow.modelVersions"]) == [{"name": "wrist plane", "version": "1"}]
    assert f"`armscan evaluate {run_id}" in first.description
    assert str(client.get_model_version_by_alias("wrist plane", "champion").version) == "1"
    assert client.get_run(run_id).data.tags["policy"] == "kept"
    models = [mlflow.pyfunc.load_model(uri) for uri in ("models:/wrist plane/1", f"runs:/{run_id}/policy")]
    np.testing.assert_array_equal(*(model.predict(model.input_example) for model in models))

    # As a run leaves them.
    played = evaluation_of(2, 4).to_dict()
    contents = {"evaluation": {"training volumes": played, "test volumes": played}, "baselines": {"random": played}}
    for name, each in contents.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(each))
        client.log_artifact(run_id, str(tmp_path / f"{name}.json"))
    made_at = client.get_run(run_id).info.end_time
    assert answer("register", run_id, "--name=wrist plane")[0] == 0
    second = client.get_model_version("wrist plane", "2")
    assert "### at the end of the run\n\nOn plane, 5 mm 10°: agent 100.0% " in second.description
    assert "\n\n| with 95 % intervals | training volumes | test volumes | random, test volumes |" in second.description
    assert "| steps, mean | 3.00 (2.00–4.00) | 3.00 (2.00–4.00) | 3.00 (2.00–4.00) |" in second.description
    assert second.tags["test_volumes/mean_steps"] == "3"
    assert second.source == first.source
    assert str(client.get_model_version_by_alias("wrist plane", "champion").version) == "2"
    assert client.get_run(run_id).info.end_time == made_at

    assert armscan("evaluate", run_id, "--episodes=2", "--success-threshold=0.2")[0] == 0
    (child,) = [run for run in runs_in(tmp_path)[1] if run.info.run_id != run_id]
    assert answer("register", run_id, "--name=wrist plane")[0] == 0
    third = client.get_model_version("wrist plane", "3")
    assert f"### by evaluation {child.info.run_id}, on configured volumes, success_threshold=0.2\n" in third.description
    assert "### at the end of the run" in third.description
    assert len(third.description) <= MAX_CHARS
    assert {"test_volumes/success_rate", "training_volumes/success_rate"} <= third.tags.keys()


def test_invalid_arguments_are_answered_in_one_line_and_change_nothing(answer, tmp_path):
    run_id = tracked(tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").write_text("precious")
    (tmp_path / "file").write_text("precious")
    run, out, name = run_id, "--out=new", "--name=n"
    before = sorted(path.name for path in tmp_path.iterdir())
    words_and_lines = [
        (["delete", run], "No such command 'delete'."),
        (["export"], "Missing argument 'RUN'."),
        (["export", run, run, out], f"Got unexpected extra argument ({run})"),
        (["export", run], "Missing option '--out'."),
        (["register", run], "Missing option '--name'."),
        (["export", run, out, name], "No such option '--name'."),
        (["export", run, "--out="], "Invalid value for '--out': a path is required."),
        (["export", run, out, "--tracking="], "Invalid value for '--tracking': an address is required."),
        (["export", "nobody", out], "the run is 'nobody', but it must be an ID"),
        (["export", "0" * 32, out], f"the run is '{'0' * 32}', but no run of"),
        (["export", run, out, "--tracking=sqlite:///none.db"], "tracking.uri is 'sqlite:///none.db', but there is no"),
        (["export", run, "--out=other"], "--out is 'other', but something else is there, and would be lost"),
        (["export", run, "--out=file"], "--out is 'file', but something else is there, and would be lost"),
        (["export", run, "--out=file/in/it"], "file/in/it: the model cannot be written (Not a directory)"),
        *(
            (["register", run, f"--name={bad}"], f"--name is '{bad}', but it must be a string")
            for bad in ("a/b", "a:b", "..", " ", "")
        ),
        (["register", run, f"--name={'a' * 257}"], "--name is 'aaa"),
        (["register", "0" * 32, name], f"the run is '{'0' * 32}', but no run of"),
    ]
    for words, line in words_and_lines:
        assert_refused(answer(*words), line)
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert store_of(tmp_path).search_registered_models() == []
    assert "policy" not in {file.path for file in store_of(tmp_path).list_artifacts(run_id)}


def test_run_without_a_policy_is_refused(answer, tmp_path):
    baseline = tracked(tmp_path, agent=GUESSER)
    evaluation = tracked(tmp_path)
    store_of(tmp_path).set_tag(evaluation, EVALUATED_TAG, baseline)
    unfinished = tracked(tmp_path, kept=("config.yaml", "volumes.json"))
    lines = {
        baseline: f"run is '{baseline}', but its agent does not learn and has no policy",
        evaluation: f"run is '{evaluation}', but that is an evaluation, of {baseline}",
        unfinished: f"run {unfinished} stored no checkpoint",
    }
    for words in EXPORT, REGISTER:
        for run_id, line in lines.items():
            assert_refused(answer(*words, run_id, "--trust"), line)
    assert not (tmp_path / "new").exists()
    assert store_of(tmp_path).search_registered_models() == []


def test_damaged_checkpoint_is_told_and_changes_nothing(answer, tmp_path):
    run_id = tracked(tmp_path)
    file, client = tmp_path / BEST_CHECKPOINT, store_of(tmp_path)
    weights, facts = load_checkpoint(file)
    whole = file.read_bytes()
    damages = {
        "best.pt: is damaged: its contents are not those that were written": whole[: len(whole) // 2],
        "best.pt: is empty": b"",
        "best.pt: is not a checkpoint of armscan": b"nonsense",
    }
    for line, contents in damages.items():
        file.write_bytes(contents)
        client.log_artifact(run_id, str(file))
        assert_refused(answer(*EXPORT, run_id), f"run {run_id}: {line}")
    save_checkpoint(file, {"other": next(iter(weights.values()))}, facts)
    client.log_artifact(run_id, str(file))
    assert_refused(answer(*REGISTER, run_id), f"run {run_id}: the checkpoint is another agent's")
    assert not (tmp_path / "new").exists()
    assert client.search_registered_models() == []
    assert "policy" not in {file.path for file in client.list_artifacts(run_id)}


def registered(answer, folder, *words):
    """Register the policy of a new run; return the run's ID, and the folder of the model among its artifacts."""
    run_id = tracked(folder, *words)
    assert answer("register", run_id, "--name=n")[0] == 0
    return run_id, folder / "artifacts" / run_id / "artifacts" / "policy"


def versions_in(folder):
    return [version.run_id for version in store_of(folder).search_model_versions("name='n'")]


def test_policy_of_another_run_is_not_registered_in_the_place_of_the_kept_one(answer, tmp_path):
    run_id, model = registered(answer, tmp_path)
    _, another = registered(answer, tmp_path, "projection=zy")
    before, whole = versions_in(tmp_path), tmp_path / "whole"
    shutil.copytree(model, whole)
    line = f"error: run {run_id}: its policy/ differs from the one that the run saved: changed, or another run's; "

    def is_refused():
        code, _, errors = answer("register", run_id, "--name=n")
        return code == 2 and errors.startswith(line) and len(errors.splitlines()) == 1

    for name in ("artifacts/policy.pt2", "policy.onnx", "MLmodel"):
        shutil.copy(another / name, model / name)
        assert is_refused(), name
        shutil.copy(whole / name, model / name)
    (model / "artifacts" / "policy.pt2").unlink()
    assert is_refused()
    shutil.copytree(another, model, dirs_exist_ok=True)
    assert is_refused()
    store_of(tmp_path).set_tag(run_id, SUM_TAG, model_sha256(model))
    assert is_refused()
    assert versions_in(tmp_path) == before

    # As left by earlier versions: nothing says that it is the one that was kept.
    store_of(tmp_path).delete_tag(run_id, SUM_TAG)
    assert answer("register", run_id, "--name=n")[0] == 0
    assert mlflow.pyfunc.load_model("models:/n/3").metadata.metadata["run"] == run_id
    assert store_of(tmp_path).get_run(run_id).data.tags[SUM_TAG] == model_sha256(model)


def damaged(network, how):
    """Return an ONNX network whose last step is endless, infinite or too wide."""
    model = onnx.load_from_string(network)
    graph, last = model.graph, model.graph.output[0].name
    for node in graph.node:
        node.output[:] = ["before" if name == last else name for name in node.output]
    graph.output[0].type.tensor_type.ClearField("shape")
    values = {"true": np.array(True), "zero": np.array(0, np.float32), "one": np.array([0])}
    graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in values.items())
    kinds = [("n", TensorProto.INT64, []), ("again", TensorProto.BOOL, []), ("kept", TensorProto.FLOAT, None)]
    same = [helper.make_node("Identity", [name], [f"{name}_after"]) for name in ("again", "kept")]
    inputs = [helper.make_tensor_value_info(*each) for each in kinds]
    outputs = [helper.make_tensor_value_info(f"{name}_after", *each) for name, *each in kinds[1:]]
    loop = helper.make_graph(same, "loop", inputs, outputs)
    last_node = {
        "endless": helper.make_node("Loop", ["", "true", "before"], [last], body=loop),
        "infinite": helper.make_node("Div", ["before", "zero"], [last]),
        "first": helper.make_node("Gather", ["before", "one"], [last], axis=0),
        "wider": helper.make_node("Concat", ["before", "before"], [last], axis=1),
    }[how]
    graph.node.append(last_node)
    return model.SerializeToString()


def test_model_that_does_not_answer_is_not_registered_and_only_one_line_told(answer, tmp_path, monkeypatch):
    run_id, model = registered(answer, tmp_path)
    program, facts = model / "policy.onnx", model / "MLmodel"
    text = facts.read_text()
    network = program.read_bytes()
    monkeypatch.setattr(build, "MAX_ANSWER_S", 1.0)

    def is_refused(reason):
        store_of(tmp_path).set_tag(run_id, SUM_TAG, model_sha256(model))
        line = f"run {run_id}: its policy/ is damaged or does not answer its own example: "
        refused = answer("register", run_id, "--name=n")
        assert_refused(refused, line)
        assert reason in refused[2]

    program.write_bytes(network[:1000])
    is_refused("")
    program.write_bytes(damaged(network, "endless"))
    is_refused("policy.onnx has not answered within 1 s")
    for how in ("infinite", "wider", "first"):
        program.write_bytes(damaged(network, how))
        is_refused("for each observation, it must give as many finite numbers as the action has: 1")
    program.write_bytes(network)
    for differs in ("[a, b]", ".nan", "{a: b}"):
        facts.write_text(text.replace("differs_from_agent: null", f"differs_from_agent: {differs}"))
        is_refused("its differs_from_agent must be a string")
    assert len(versions_in(tmp_path)) == 1

    # It cannot add headings to the card, nor make it too long.
    headings = json.dumps("# a\n" * 9000)
    facts.write_text(text.replace("differs_from_agent: null", f"differs_from_agent: {headings}"))
    store_of(tmp_path).set_tag(run_id, SUM_TAG, model_sha256(model))
    assert answer("register", run_id, "--name=n")[0] == 0
    card = store_of(tmp_path).get_model_version("n", "2").description
    assert "Note: this policy has not been evaluated; # a # a" in card
    assert len(card) < MAX_CHARS


def test_policy_is_not_registered_with_a_damaged_evaluation(answer, tmp_path):
    run_id, model = registered(answer, tmp_path)
    for damaged in ('{"a": 1}', "{}"):
        (model.parent / "evaluation.json").write_text(damaged)
        line = f"error: run {run_id}: its evaluation.json is damaged; put it back, or remove it"
        assert answer("register", run_id, "--name=n") == (2, "", line)
    assert len(versions_in(tmp_path)) == 1


@pytest.mark.parametrize(
    ("part", "beginning"),
    [
        ("", "the artifacts of runs lie in "),
        # Noticed only once the model is made.
        ("{run_id}/artifacts", "tracking.uri is 'sqlite:///"),
    ],
    ids=["all", "the run's"],
)
def test_policy_is_not_registered_where_artifacts_are_read_only(answer, tmp_path, made_read_only, part, beginning):
    run_id = tracked(tmp_path)
    with made_read_only(tmp_path / "artifacts" / part.format(run_id=run_id)):
        refused = answer("register", run_id, "--name=n")
    assert_refused(refused, f"{beginning}{tmp_path}/")
    assert refused[1] == ""
    assert refused[2].endswith(": Read-only file system")
    client = store_of(tmp_path)
    assert client.search_registered_models() == []
    assert not {"policy", SUM_TAG} & client.get_run(run_id).data.tags.keys()
    assert "policy" not in {file.path for file in client.list_artifacts(run_id)}
