"""The agents of evaluations: from a run with its checkpoint, or a baseline by its name."""

import io
import json
import zipfile
from functools import partial

import pytest
import torch

from armscan.training import load_checkpoint, save_checkpoint
from armscan.utils.files import sha256
from tests.support.refusals import assert_refused
from tests.support.tracked_runs import GUESSER, store_of, tracked
from tests.test_run import runs_in


def test_baselines_are_evaluated_by_their_run_or_by_name(evaluate, tmp_path, phantom):
    run_id = tracked(tmp_path, "projection=zy", agent=GUESSER)
    assert evaluate(run_id, "--trust", "--data=phantom", "--phantoms=2", "--episodes=2", "--out=run.json")[0] == 0
    words = [
        "--agent=sac",
        "~agent.network",
        "agent._target_=tests.support.tracked_runs.GuesserOfAnything",
        "projection=zy",
    ]
    code, _, errors = evaluate(
        *words, "--data=phantom", "--phantoms=2", "--episodes=2", "--max-steps=50", "--out=agent.json"
    )
    assert (code, errors) == (0, "")
    by_name = json.loads((tmp_path / "agent.json").read_text())
    assert by_name["of"] == "sac"
    tags = store_of(tmp_path).get_run(by_name["tracked_as"]).data.tags
    assert "mlflow.parentRunId" not in tags


def test_baseline_takes_a_preset_as_a_run_does_and_an_experiment_of_mlflow(evaluate, tmp_path):
    words = [
        "--agent=random",
        "experiment=best_full",
        "--data=phantom",
        "--phantoms=1",
        "--episodes=1",
        "--tracking-experiment=x",
        "evaluation.on_plane=[[3,5]]",
    ]
    code, printed, errors = evaluate(*words)
    assert (code, errors) == (0, "")
    client = store_of(tmp_path)
    (run,) = client.search_runs([client.get_experiment_by_name("x").experiment_id])
    assert run.data.params["projection"] == "full"
    assert "On plane, 3 mm 5°: agent" in printed
    assert run.data.params["agent._target_"] == "armscan.agents.Random"


def test_evaluate_of_a_multirun_asks_for_one_of_its_jobs(evaluate, tmp_path):
    job_id = tracked(tmp_path)
    client = store_of(tmp_path)
    parent = client.create_run(client.get_run(job_id).info.experiment_id, run_name="multirun")
    client.set_tag(job_id, "mlflow.parentRunId", parent.info.run_id)
    _, _, errors = evaluate(parent.info.run_id)
    assert errors == f"error: run {parent.info.run_id} has runs below it: give one of them, {job_id}"


def test_runs_that_have_kept_too_little_are_refused_with_what_to_do(evaluate, tmp_path):
    run_id = tracked(tmp_path, kept=())
    assert_refused(evaluate(run_id), f"run {run_id} has no config.yaml among its artifacts, as each")
    run_id = tracked(tmp_path, kept=("config.yaml", "volumes.json"))
    assert evaluate(run_id)[2] == (f"error: run {run_id} stored no checkpoint: nothing to evaluate")
    client = store_of(tmp_path)
    for status, ended in (("KILLED", "ended before its time (KILLED)"), ("RUNNING", "is still running, or was killed")):
        client.update_run(run_id, status=status)
        assert evaluate(run_id)[2] == (
            f"error: run {run_id} {ended}, and a run keeps its checkpoint in the store at its end: resume it with "
            f"python -m armscan.run resume={run_id}"
        )


NOT_DENSE = "holds weights that are no dense tensor of its own,"


def with_nan(weights, facts):
    name = next(iter(weights))
    return weights | {name: weights[name] * float("nan")}, facts


def with_weight(weight, weights, facts):
    return weights | {"w": weight}, facts


def with_n_env_steps(n_env_steps, weights, facts):
    return weights, facts | {"n_env_steps": n_env_steps}


def test_checkpoint_that_is_larger_in_memory_than_on_disk_is_refused(evaluate, tmp_path):
    run_id = tracked(tmp_path)
    contents, packed = io.BytesIO((tmp_path / "best.pt").read_bytes().partition(b"\n")[2]), io.BytesIO()
    with zipfile.ZipFile(contents) as archive, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as compressed:
        for name in archive.namelist():
            compressed.writestr(name, archive.read(name) + b"0" * 10**6)

    # And one whose end, which torch believes, could point to another directory than the one that Python reads.
    shifted = io.BytesIO((tmp_path / "best.pt").read_bytes().partition(b"\n")[2])
    with zipfile.ZipFile(shifted, "a") as archive:
        archive.comment = b"moved"
    for contents in (packed, shifted):
        header = f"armscan checkpoint 1 {sha256(contents.getvalue())}\n".encode()
        (tmp_path / "changed").mkdir(exist_ok=True)
        (tmp_path / "changed/best.pt").write_bytes(header + contents.getvalue())
        store_of(tmp_path).log_artifact(run_id, str(tmp_path / "changed/best.pt"))
        line = f"run {run_id}: best.pt: is not a checkpoint: its archive of {len(contents.getvalue())} bytes"
        assert_refused(evaluate(run_id), line)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            lambda weights, facts: (weights, facts | {"run_id": "5f"}),
            "best.pt: is a checkpoint of run '5f', but this is",
        ),
        (
            lambda weights, facts: (weights, facts | {"reports": "[]"}),
            "best.pt: holds a full training state, as last.pt does",
        ),
        (lambda weights, facts: ({"other": 1}, facts), "the checkpoint is another agent's or network's"),
        (lambda weights, facts: ([1], facts), "best.pt: is not a checkpoint: it contains something other"),
        (with_nan, "best.pt: holds weights that are not finite, in "),
        (lambda weights, facts: (weights | {"w": torch.zeros(1).expand(10**12)}, facts), f"best.pt: {NOT_DENSE} in w"),
        (lambda weights, facts: (weights | {"w": torch.zeros(3).to_sparse()}, facts), f"best.pt: {NOT_DENSE} in w"),
        (lambda weights, facts: (weights | {"w": torch.zeros(3, device="meta")}, facts), f"best.pt: {NOT_DENSE} in w"),
        (lambda weights, facts: (weights | {3: 1}, facts), "best.pt: names weights by an int, but"),
        *(
            (partial(with_weight, torch.zeros(4, dtype=torch.uint8).view(dtype)), f"best.pt: {NOT_DENSE} in w")
            for dtype in (torch.float8_e4m3fn, torch.bits8)
        ),
        *(
            (partial(with_n_env_steps, n), "the n_env_steps of its checkpoint must be a whole number from 0 to")
            for n in ("abc", float("inf"), -5, 2**70)
        ),
    ],
)
def test_checkpoints_that_are_none_of_the_run_are_refused_before_anything_is_tracked(evaluate, tmp_path, change, line):
    run_id = tracked(tmp_path)
    save_checkpoint(tmp_path / "best.pt", *change(*load_checkpoint(tmp_path / "best.pt")))
    client, runs = runs_in(tmp_path)
    client.log_artifact(run_id, str(tmp_path / "best.pt"))
    refused = evaluate(run_id)
    assert_refused(refused, f"run {run_id}: {line}")
    assert len(refused[2]) < 350
    assert len(runs_in(tmp_path)[1]) == len(runs)


@pytest.mark.parametrize("name", ["config.yaml", "volumes.json", "best.pt"])
def test_artifacts_that_were_changed_are_refused(evaluate, tmp_path, name):
    run_id = tracked(tmp_path)
    contents = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(contents.replace(b"0", b"1"))
    client = store_of(tmp_path)
    client.log_artifact(run_id, str(tmp_path / name))
    what = "best.pt: is damaged" if name == "best.pt" else f"its {name} is not the one that it was started with"
    assert_refused(evaluate(run_id), f"run {run_id}: {what}")


@pytest.mark.parametrize(("text", "what"), [("a: [", "is damaged"), ("3", "is damaged")])
def test_configuration_without_a_sum_must_still_be_one(evaluate, tmp_path, text, what):
    run_id = tracked(tmp_path, kept=())
    (tmp_path / "config.yaml").write_text(text)
    store_of(tmp_path).log_artifact(run_id, str(tmp_path / "config.yaml"))
    assert evaluate(run_id)[2] == f"error: run {run_id}: its config.yaml {what}"
