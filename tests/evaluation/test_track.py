"""Files and runs of an evaluation: tables, a JSON file, and a run of its own in the store."""

import pytest

from tests.support.tracked_runs import store_of, tracked, written
from tests.test_run import runs_in


def test_evaluate_gives_figures_with_intervals_as_table_json_and_metrics(evaluate, tmp_path):
    run_id = tracked(tmp_path)
    code, printed, errors = evaluate(run_id, "--episodes=5", "--max-steps=3", "--success-threshold=0.04")
    assert (code, errors) == (0, "")
    for word in (
        "on plane,",
        "5 mm 10°",
        "random",
        "sweep 5 mm",
        "steps, 95th percentile",
        "Dice artery,",
        "phantom-2000000",
        "not started solved",
    ):
        assert word in printed
    contents = written(tmp_path)
    assert contents["of"] == run_id
    assert contents["changes"] == {"max_steps": 3, "success_threshold": 0.04}
    changed = "changed for this evaluation: max_steps=3, success_threshold=0.04"
    assert printed.count(f"note: {changed}\n") == 3
    assert contents["notes"] == []
    assert changed in next(tmp_path.glob("evaluations/*.html")).read_text()
    assert list(contents["splits"]) == ["training volumes", "validation volumes", "test volumes"]
    assert max(episode["n_steps"] for episode in contents["episodes"]["test volumes"]) <= 3
    assert list(contents["volumes"]["test volumes"]) == ["phantom-2000000"]
    client = store_of(tmp_path)
    child = client.get_run(contents["tracked_as"])
    assert child.data.tags["mlflow.parentRunId"] == child.data.tags["evaluation.of"] == run_id
    for figure in ("success_rate", "p95_steps", "mean_best_reward", "median_distance_deg", "mean_dice_bones"):
        numbers = contents["splits"]["test volumes"]["figures"][figure]
        assert numbers["low"] <= numbers["value"] <= numbers["high"]
        for group in ("test_volumes", "volume/phantom-2000000"):
            assert child.data.metrics[f"{group}/{figure}"] == pytest.approx(numbers["value"])
            assert child.data.metrics[f"{group}/{figure}_low"] == pytest.approx(numbers["low"])
    assert child.info.run_name.endswith(", max_steps=3, success_threshold=0.04")
    description = child.data.tags["mlflow.note.content"]
    assert description.startswith(f"Note: {changed}.\n\n### training volumes\n\n")
    assert "\n\n| with 95 % intervals | agent | random |" in description
    assert child.data.params["env.max_steps"] == "3"
    # By which `armscan runs list` knows the leading rate.
    assert child.data.params["evaluation.on_plane"].startswith("[[5.0, 10.0]")
    assert {file.path[-5:] for file in client.list_artifacts(child.info.run_id)} == {".json", ".html"}
    assert 0.0 <= child.data.metrics["random/test_volumes/on_plane_5mm_10deg"] <= 1.0
    # The run itself stays as it was, and an evaluation is nothing to evaluate.
    assert not client.get_run(run_id).data.metrics
    code, _, errors = evaluate(contents["tracked_as"])
    assert (code, errors) == (2, f"error: run is {contents['tracked_as']!r}, but that is an evaluation, of {run_id}")


def test_runs_show_has_the_notes_of_an_evaluation(evaluate, armscan, tmp_path):
    run_id = tracked(tmp_path)
    assert evaluate(run_id, "--episodes=1", "--max-steps=3")[0] == 0
    code, printed, _ = armscan("runs", "show", written(tmp_path)["tracked_as"])
    assert code == 0
    assert "Note: changed for this evaluation: max_steps=3." in printed
    assert "on plane, 5 mm 10°" in printed
    assert "Note: 1 subject, fewer than 8" in " ".join(printed.split())


def test_evaluate_makes_nothing_where_artifacts_are_read_only(evaluate, tmp_path, made_read_only):
    run_id = tracked(tmp_path)
    with made_read_only(tmp_path / "artifacts"):
        code, _, errors = evaluate(run_id, "--episodes=3")
    assert code == 2
    assert errors.startswith(f"error: the artifacts of runs lie in {tmp_path}/artifacts")
    assert len(runs_in(tmp_path)[1]) == 1
    assert not list(tmp_path.glob("evaluations/*"))
