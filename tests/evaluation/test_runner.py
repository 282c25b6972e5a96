"""Evaluations of real tracked runs, as a user types them, on volumes that an agent can and cannot be applied to."""

import json
import subprocess
import sys

import pytest
import yaml

from tests.support.tracked_runs import IMAGES, tracked, written
from tests.test_run import SMALL, armscan_run, runs_in


@pytest.mark.slow
def test_evaluate_judges_a_run_as_it_was_trained(tmp_path, data_folder):
    assert armscan_run(*SMALL, cwd=tmp_path).returncode == 0
    client, (run,) = runs_in(tmp_path)
    command = [sys.executable, "-m", "armscan", "evaluate", run.info.run_id[:10]]
    for words in (["--episodes=3"], ["--episodes=4", f"--data={data_folder}", "--success-threshold=0.1"]):
        ended = subprocess.run([*command, *words], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (ended.returncode, ended.stderr) == (0, "")
        assert "on plane,  " in ended.stdout
    children = client.search_runs([run.info.experiment_id], f"tags.mlflow.parentRunId = '{run.info.run_id}'")
    assert len(children) == 2
    assert {file.path for file in client.list_artifacts(run.info.run_id)} >= {"best.pt", "config.yaml"}


def test_evaluate_gives_the_same_figures_again(evaluate, tmp_path):
    run_id = tracked(tmp_path, "projection=zy")
    figures = []
    # The second replaces the first.
    for _ in range(2):
        assert evaluate(run_id, "--episodes=4", "--seed=3", "--out=a.json")[0] == 0
        contents = json.loads((tmp_path / "a.json").read_text())["splits"]["test volumes"]["figures"]
        figures.append({key: value for key, value in contents.items() if "seconds" not in key})
    assert figures[0] == figures[1]


def test_agent_is_applied_to_volumes_of_other_sizes_and_spacing(evaluate, tmp_path, coarse_folder):
    run_id = tracked(tmp_path, "reward=agreement", "env.clustering=metric", "obs.normalised=false")
    code, printed, errors = evaluate(run_id, f"--data={coarse_folder}", "--episodes=3")
    assert (code, errors) == (0, "")
    assert "note: train split: a pixel is 0.4 mm across (trained on 0.27)" in printed
    contents = written(tmp_path)
    assert list(contents["splits"]) == ["train split", "test split", "all volumes"]
    assert contents["splits"]["all volumes"]["episodes"] == 6
    assert contents["notes"]


def test_labelled_planes_that_score_too_little_are_refused_with_what_may_be_the_reason(
    evaluate, tmp_path, coarse_folder
):
    run_id = tracked(tmp_path)
    manifest = yaml.safe_load((coarse_folder / "manifest.yaml").read_text())
    manifest["volumes"]["b.nii.gz"]["translation"][1] -= 60
    (coarse_folder / "manifest.yaml").write_text(yaml.safe_dump(manifest))
    for word, ending in (
        ("--seed=0", "here a pixel has 0.45 x 0.5 mm: unless the plane is wrong, --clustering metric may see them"),
        ("--clustering=metric", "but it must score above -success_threshold = -0.05"),
    ):
        code, _, errors = evaluate(run_id, f"--data={coarse_folder}", "--episodes=2", word)
        assert code == 2
        assert errors.startswith("error: b.nii.gz: the labelled plane scores")
        assert errors.endswith(ending)


def test_images_of_another_shape_are_refused_with_the_reason(evaluate, tmp_path, coarse_folder):
    run_id = tracked(tmp_path, "obs=slice", "obs.shape=null", "env.clustering=metric", *IMAGES)
    code, _, errors = evaluate(run_id, f"--data={coarse_folder}", "--episodes=2")
    assert code == 2
    assert "the agent was trained on images of" in errors
    assert "it cannot be applied to them" in errors
    assert evaluate(run_id, "--data=phantom", "--phantoms=1", "--episodes=1")[0] == 0


def test_run_that_has_not_kept_what_it_was_trained_on_is_refused_by_its_network(evaluate, tmp_path, coarse_folder):
    run_id = tracked(tmp_path, "obs=slice", "obs.shape=null", "env.clustering=metric", *IMAGES, has_tag=False)
    code, _, errors = evaluate(run_id, f"--data={coarse_folder}", "--episodes=2")
    assert code == 2
    assert "the checkpoint is another agent's or network's" in errors
