"""Runs listed and shown: filters, order, folded children, disk usage."""

import csv
import io
import json
import re
import sqlite3
import time

import pytest

from armscan.tracking.uploader import DESCRIPTION_SUM_TAG
from armscan.utils.files import sha256
from armscan.utils.text import format_duration

DAY_S = 86400.0


@pytest.fixture
def aged(tmp_path):
    """Set the age of a run in days and its duration in seconds; return its ID."""

    def change(run_id, *, days=0.0, took_s=60.0):
        start_ms = round((time.time() - days * DAY_S) * 1000)
        with sqlite3.connect(tmp_path / "mlruns.db") as database:
            values = (start_ms, start_ms + round(took_s * 1000), run_id)
            database.execute("update runs set start_time = ?, end_time = ? where run_uuid = ?", values)
        return run_id

    return change


@pytest.fixture
def listed(answer):
    """Return the names of the listed runs, in order."""

    def names(*words):
        code, printed, errors = answer("list", "--format=json", *words)
        assert (code, errors) == (0, "")
        return [row["name"] for row in json.loads(printed)]

    return names


def judged(success_rate, mean_steps):
    return {"test_volumes/success_rate": success_rate, "test_volumes/mean_steps": mean_steps}


@pytest.fixture
def three(make_run, aged):
    """Return runs of different agents, ages and metrics; the last was never evaluated."""
    tags = [{"choice.agent": agent, "choice.obs": obs} for agent, obs in (("sac", "slice"), ("ppo", "cluster"))]
    return [
        aged(make_run("a", tags=tags[0], figures=judged(0.5, 9.0)), days=1, took_s=30),
        aged(make_run("b", tags=tags[1], figures=judged(0.9, 12.0)), days=10, took_s=20),
        aged(make_run("c", tags=tags[1], status="FAILED"), days=40, took_s=90),
    ]


SELECTED = [
    ([], "abc"),
    (["--status=failed"], "c"),
    (["--status=failed,finished"], "abc"),
    (["--status=running"], ""),
    (["--agent=ppo"], "bc"),
    (["--agent=ppo,sac", "--obs=slice"], "a"),
    (["--projection=zy"], "abc"),
    (["--projection=y, zy"], "abc"),
    (["--projection=[rz,ty]"], ""),
    (["--since=7d"], "a"),
    (["--before=1w"], "bc"),
    (["--since=11d", "--before=12h"], "ab"),
    (["--since=2000-01-01"], "abc"),
    (["--before=2000-01-01T12:00"], ""),
    (["--where=metrics.`test_volumes/success_rate` > 0.6"], "b"),
    (["--where=tags.`choice.obs` = 'cluster'", "--before=20d"], "c"),
    (["--sort=started"], "cba"),
    (["--sort=duration"], "bac"),
    (["--sort=-duration"], "cab"),
    (["--sort=success"], "abc"),
    (["--sort=-success"], "bac"),
    (["--sort=-steps"], "bac"),
    (["--sort=-success", "--limit=2"], "ba"),
    (["--experiment=armscan"], "abc"),
    (["--experiment=unused"], ""),
]


def test_list_has_what_is_asked_for_in_its_order(three, listed):
    found = [(words, "".join(listed(*words))) for words, _ in SELECTED]
    assert found == SELECTED


@pytest.fixture
def family(store, make_run, aged):
    """Return a multirun of two jobs, of which one was evaluated, with another run beside it."""
    client, experiment_id = store
    parent_id = client.create_run(experiment_id, name="multirun", tags={}).info.run_id
    client.set_terminated(parent_id)
    aged(parent_id, days=3)
    jobs = [aged(make_run(f"job{number}", parent_id=parent_id), days=2 - number) for number in range(2)]
    tags = {"mlflow.parentRunId": jobs[0], "evaluation.of": jobs[0]}
    evaluation = client.create_run(experiment_id, name="evaluation", tags=tags).info.run_id
    client.set_terminated(evaluation)
    aged(make_run("alone"), days=5)
    return parent_id, *jobs


def test_children_are_folded_into_their_parent_and_unfolded_where_that_is_asked_for(family, listed, answer):
    parent_id, *_ = family
    assert listed() == ["multirun", "alone"]
    assert listed("--children") == ["multirun", "job0", "evaluation", "job1", "alone"]
    assert listed(f"--parent={parent_id[:8]}") == ["job1", "job0"]
    assert listed(f"--parent={parent_id[:8]}", "--children") == ["job1", "job0", "evaluation"]
    # If their parent is not selected, children stand by themselves.
    assert listed("--where=attributes.run_name LIKE 'job%'") == ["job1", "job0"]
    rows = json.loads(answer("list", "--format=json")[1])
    assert [row["below"] for row in rows] == [3, 0]
    unfolded = json.loads(answer("list", "--format=json", "--children")[1])
    assert rows[0]["size_bytes"] == sum(row["size_bytes"] for row in unfolded[:-1])
    assert [row["parent"] for row in unfolded[1:4]] == [parent_id, family[1], parent_id]


def test_sizes_are_those_of_the_folder_and_of_the_artifacts(make_run, answer, tmp_path, listed):
    make_run("small")
    make_run("large")
    with (tmp_path / "outputs" / "large" / "last.pt").open("ab") as file:
        file.write(bytes(500_000))
    (tmp_path / "outputs" / "small" / "mine.bin").write_bytes(bytes(2_000_000))
    assert listed("--sort=-size") == ["large", "small"]
    large, small = json.loads(answer("list", "--sort=-size", "--format=json")[1])
    assert (
        small["artifact_bytes"]
        == large["artifact_bytes"]
        == sum(file.stat().st_size for file in tmp_path.glob(f"mlartifacts/{small['run_id']}/artifacts/*"))
    )
    assert 503_000 < large["folder_bytes"] < 510_000
    # What is not the run's is not counted: prune would leave it.
    assert small["folder_bytes"] < 10_000


def test_table_fits_eighty_columns_and_csv_has_whole_ids(three, answer, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, table, _ = answer("list")
    assert code == 0
    assert max(map(len, table.splitlines())) <= 80
    assert all(run_id[:8] in table for run_id in three)
    assert "90%" in table
    rows = list(csv.DictReader(io.StringIO(answer("list", "--format=csv")[1])))
    assert [row["run_id"] for row in rows] == three
    assert (rows[0]["success_rate"], rows[2]["success_rate"]) == ("0.5", "")


def test_long_names_stay_whole_and_odd_ones_are_no_markup(make_run, answer, monkeypatch):
    name = "sac-[bold]-cluster_slice_channels-rz+rx+tx+ty-stack4-memory2-phantom-seed0"
    run_id = make_run(name)
    monkeypatch.setenv("COLUMNS", "80")
    *_, above, row = answer("list")[1].splitlines()
    assert above == name
    assert row.startswith(run_id[:8])
    assert len(row) <= 80
    # In a log, a row is one line.
    monkeypatch.delenv("COLUMNS")
    assert name in (row := answer("list")[1].splitlines()[-1])
    assert run_id[:8] in row


def test_on_plane_rate_is_within_the_limits_that_each_run_is_configured_with(make_run, store, answer):
    client, _ = store
    strict = make_run("strict", figures={"test_volumes/on_plane_3mm_5deg": 0.25})
    client.log_param(strict, "evaluation.on_plane", "[[3, 5], [1, 2]]")
    make_run("usual", figures={"test_volumes/on_plane_5mm_10deg": 0.75})
    rows = {row["name"]: row for row in csv.DictReader(io.StringIO(answer("list", "--format=csv")[1]))}
    limits = ("on_plane_rate", "on_plane_mm", "on_plane_deg")
    assert [rows["strict"][name] for name in limits] == ["0.25", "3.0", "5.0"]
    assert [rows["usual"][name] for name in limits] == ["0.75", "5.0", "10.0"]
    table = answer("list")[1]
    assert "25% (3 mm 5°)" in table
    assert "75% (5 mm 10°)" in table
    assert "3 mm" in answer("list", "--limit=1", "--sort=plane")[1]


def test_grid_says_that_its_figures_are_those_of_its_best_job(make_run, store, answer):
    client, _ = store
    grid = make_run("grid", figures={"test_volumes/on_plane_5mm_10deg": 0.5, "test_volumes/success_rate": 0.5})
    client.set_tag(grid, "best.run", "b" * 32)
    assert "best 50%" in answer("list")[1]
    assert "b" * 32 in answer("list", "--format=csv")[1]
    assert f"figures of its best job, {'b' * 8}" in answer("show", grid)[1]


def test_show_tells_everything_of_a_run(make_run, store, answer, tmp_path):
    tags = {"overrides": "agent=sac seed=3", "git.commit": 40 * "a", "something.new": "[red]x"}
    figures = {"validation/success_rate": 0.75, **judged(0.5, 9.25), "volume/a/success_rate": 0.1}
    run_id = make_run(tags=tags, figures=figures, status="FAILED")
    client, experiment_id = store
    child = client.create_run(experiment_id, name="evaluation: x", tags={"mlflow.parentRunId": run_id}).info.run_id
    code, printed, errors = answer("show", run_id[:8])
    assert (code, errors) == (0, "")
    for told in (
        *(run_id, "failed after", "no reason", "agent=sac seed=3", 40 * "a", "something.new", "[red]x", child[:8]),
        *(
            "last validation",
            "test",
            "75.0%",
            "9.25",
            "best.pt",
            "1.0 kB",
            ".hydra/config.yaml",
            "evaluation: x",
        ),
        str(tmp_path / "outputs" / "tiny"),
        f"resume    python -m armscan.run resume={run_id}\n",
        f"evaluate  armscan evaluate {run_id}\n",
        f"record    armscan evaluate {run_id} --video\n",
    ):
        assert told in printed
    assert "volume/a" not in printed
    client.set_tag(run_id, "command", "python -m armscan.run agent=sac")
    assert re.search("^command +python -m armscan.run agent=sac", answer("show", run_id)[1], re.MULTILINE)


def test_show_of_a_trial_names_its_new_validation_episodes_and_does_not_call_them_a_test(make_run, answer):
    figures = {"selection/success_rate": 0.75, "selection/mean_steps": 9.25, "test/mean_steps": 3.0}
    shown = answer("show", make_run("trial 2", figures=figures, tags={"study": "s", "trial": "2"}))[1]
    assert "new validation" in shown
    assert re.search(r"success.*75\.0%", " ".join(shown.split()))
    assert "test" not in shown.partition("figures")[2].partition("folder")[0]


def test_show_of_a_study_is_its_result_and_of_a_member_of_a_population_its_best_epoch(make_run, answer):
    figures = {"validation/success_rate": 0.75, "validation/seeds": 3.0, "probability_of_improvement/success_rate": 0.2}
    result = "**Trial 2 is better.**\n\n| metric | chosen |\n| --- | --- |\n| steps, \x1b[2Jmean | 2.50 |"
    tags = {"study": "s", "mlflow.note.content": result, DESCRIPTION_SUM_TAG: sha256(result.encode())}
    shown = answer("show", make_run("study", figures=figures, tags=tags))[1]
    assert "Trial 2 is better." in shown
    assert "2.50" in shown
    assert "\x1b[2J" not in shown
    assert "75.0%" not in shown
    # A person's note is not the result.
    tags = {"study": "s", "mlflow.note.content": "rerun this"}
    assert "best validation" in answer("show", make_run("noted", figures=figures, tags=tags))[1]
    shown = answer("show", make_run("trial 2", figures=figures, tags={"study": "s", "trial": "2"}))[1]
    assert "best validation" in shown
    assert re.search(r"seeds.*\b3\b", shown)
    # A training within a trial tracks all of its epochs.
    tags = {"study": "s", "trial": "2", "choice.agent": "sac"}
    assert "last validation" in answer("show", make_run("seed 0", figures=figures, tags=tags))[1]


def test_show_of_a_parent_offers_nothing_that_it_cannot_do(family, answer):
    printed = answer("show", family[0])[1]
    assert "folder: no folder was noted for it" in printed
    assert "job0" in printed
    assert "evaluate " not in printed
    assert "resume " not in printed


def test_times_are_readable():
    assert [format_duration(s) for s in (None, 5, 65, 3605, 100_000)] == ["–", "0:05", "1:05", "1:00:05", "1d 3h"]


def test_run_that_goes_on_again_has_no_duration(answer, make_run, store, aged, listed):
    going_on, ended = aged(make_run("going_on"), took_s=90), aged(make_run("ended"), took_s=30)
    # As for a resumed run, whose earlier end MLflow keeps.
    store[0].update_run(going_on, status="RUNNING")
    assert store[0].get_run(going_on).info.end_time is not None
    rows = {row["run_id"]: row["duration_s"] for row in json.loads(answer("list", "--format=json")[1])}
    assert rows == {going_on: None, ended: 30.0}
    assert listed("--sort=-duration") == ["ended", "going_on"]
    assert "running after" not in answer("show", going_on)[1]


def test_control_characters_of_names_and_tags_do_not_reach_the_terminal(answer, make_run):
    harmful = "\x1b]0;title\x07\x1b[2J\rnew"
    run_id = make_run(f"a{harmful}", tags={"mine": harmful, f"named {harmful}": "x"})
    for words in (["list"], ["show", run_id]):
        code, printed, errors = answer(*words)
        assert (code, errors) == (0, "")
        assert "\\x1b]0;title" in printed
        assert not {each for each in printed if ord(each) < 32} - {"\n"}


def test_runs_that_are_above_themselves_are_listed(make_run, store, listed):
    client, _ = store
    ids = {name: make_run(name) for name in "abcd"}
    # Two are each other's parents, with one below them, and one is its own parent.
    for child, parent in ("ab", "ba", "cb", "dd"):
        client.set_tag(ids[child], "mlflow.parentRunId", ids[parent])
    assert set(listed("--children")) == set("abcd")
    assert set(listed()) == set("abcd")


def test_long_line_of_parents_is_listed(make_run, store, listed):
    client, experiment_id = store
    parent = make_run("first")
    for number in range(12):
        parent = client.create_run(experiment_id, name=str(number), tags={"mlflow.parentRunId": parent}).info.run_id
    assert set(listed("--children")) == {"first", *map(str, range(12))}


def test_name_that_a_spreadsheet_would_compute_is_a_text_in_csv(make_run, answer):
    make_run("=HYPERLINK(1)", folder=None)
    code, printed, _ = answer("list", "--format=csv")
    assert code == 0
    assert [row["name"] for row in csv.DictReader(io.StringIO(printed))] == ["'=HYPERLINK(1)"]
