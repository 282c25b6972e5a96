"""The report of runs, as a user makes and opens it, on real tracked runs."""

import json
import os
import shutil
from pathlib import Path

import pytest
from mlflow.entities import Metric, Param

from tests.reports.conftest import GROUPS, rows
from tests.support.refusals import assert_refused

SECTIONS = ["Learning curves", "On the test volumes", "Which is likely to be better", "Episodes", "Runs", "Numbers"]


def page(folder):
    return (folder / "report.html").read_text()


@pytest.fixture
def parent(runs):
    """Yield a parent of all runs, as in a multirun."""
    parent = runs.made("grid agent=sac,ppo seed=0,1,2")
    for each in runs.all:
        runs.client.set_tag(each.info.run_id, "mlflow.parentRunId", parent)
    yield parent
    for each in runs.all:
        runs.client.delete_tag(each.info.run_id, "mlflow.parentRunId")
    runs.client.delete_run(parent)


@pytest.fixture
def artifacts(runs):
    """Yield the folder of a run's artifacts, which is restored afterwards."""
    (run_id, *_) = runs.ids("sac")
    folder = runs.folder / "mlartifacts" / run_id / "artifacts"
    kept = runs.folder / "kept"
    shutil.copytree(folder, kept)
    yield folder
    shutil.rmtree(folder)
    kept.rename(folder)


def test_report_of_a_multirun_groups_its_jobs_and_has_every_number_beside_it(answer, runs, parent, tmp_path):
    code, printed, errors = answer(f"--runs={parent[:12]}")
    folder = tmp_path / "reports" / f"runs-{parent[:8]}"
    assert (code, errors) == (0, "")
    assert printed.splitlines() == ["reading   6 runs", f"look at   {folder.relative_to(tmp_path)}/report.html"]
    shown = page(folder)
    assert "<h1>6 runs</h1>" in shown
    assert all(f"<h2>{heading}</h2>" in shown for heading in SECTIONS)
    assert "6 runs in 2 groups" in shown
    assert "All groups: with few seeds" in shown
    table = rows(folder / "runs.csv")
    assert [(row["group"], row["seed"], row["status"]) for row in table] == [
        (group, str(seed), "finished") for group in GROUPS.values() for seed in range(3)
    ]
    final = {(row["group"], row["metric"]): row for row in rows(folder / "final.csv")}
    for agent, group in GROUPS.items():
        of_seeds = [runs.client.get_run(run_id).data.metrics["test_volumes/mean_steps"] for run_id in runs.ids(agent)]
        row = final[group, "mean_steps"]
        assert float(row["value"]) == pytest.approx(sum(of_seeds) / 3)
        assert float(row["low"]) <= float(row["value"]) <= float(row["high"])
    history = runs.client.get_metric_history(runs.ids("sac")[0], "validation/mean_return")
    seeds = [row for row in rows(folder / "seed_curves.csv") if row["run"] == runs.ids("sac")[0]]
    assert [(point.step, point.value) for point in history] == [
        (int(row["env_steps"]), float(row["value"])) for row in seeds if row["metric"] == "validation/mean_return"
    ]
    curves = [row for row in rows(folder / "curves.csv") if row["metric"] == "validation/success_rate"]
    assert {(row["group"], row["axis"]) for row in curves} == {
        (group, axis) for group in GROUPS.values() for axis in ("environment steps", "seconds of training")
    }
    pairs = rows(folder / "improvement.csv")
    assert [(row["metric"], row["better"], row["than"]) for row in pairs] == [
        (figure, GROUPS["sac"], GROUPS["ppo"])
        for figure in ("on_plane_rate", "median_distance_mm", "success_rate", "mean_steps")
    ]


def test_the_same_runs_give_the_same_report_however_they_are_named(answer, runs, parent, tmp_path):
    ids = [each.info.run_id for each in runs.all]
    for name, words in {"a": parent, "b": ",".join([*ids, ids[0][:30]]), "c": "experiment:armscan"}.items():
        assert answer(f"--runs={words}", f"--out={name}")[0] == 0
    files = [file.name for file in (tmp_path / "a").glob("*.csv")]
    assert len(files) == 6
    for name in files:
        assert len({(tmp_path / each / name).read_bytes() for each in "abc"}) == 1, name
    assert "<h1>6 runs of armscan</h1>" in page(tmp_path / "c")


def test_one_training_has_a_report_without_bands(answer, runs, tmp_path):
    assert answer(f"--runs={runs.ids('sac')[1]}", "--out=one")[0] == 0
    shown = page(tmp_path / "one")
    assert "1 run in 1 group:" in shown
    assert "sac-cluster-y-phantom<" in shown
    assert "one seed says nothing about other seeds" in shown
    assert "<h2>Which is likely" not in shown
    assert {row["low"] for row in rows(tmp_path / "one" / "curves.csv")} == {"nan"}


def test_only_those_trainings_of_a_pruned_trial_are_cut_off_that_it_was_pruned_in(answer, runs, tmp_path):
    study = runs.made("study a")
    trial = runs.made("a-0000", parent=study, pruned="true", trial="0")
    ids = []
    # The first was solved early.
    for seed, tags in enumerate(({}, {"pruned": "true"})):
        run_id = runs.made(f"sac-seed{seed}", parent=trial, **{"choice.agent": "sac", "trial": "0"} | tags)
        runs.client.log_batch(run_id, [Metric("validation/mean_steps", 3.0, 0, 100)], params_of(seed))
        runs.client.set_terminated(run_id)
        ids.append(run_id)
    for name, words in {"a": study, "b": trial, "c": ",".join(ids)}.items():
        assert answer(f"--runs={words}", f"--out={name}")[0] == 0
        assert [row["status"] for row in rows(tmp_path / name / "runs.csv")] == ["finished", "pruned"]
        assert f"with the data so far: {ids[1][:8]} (group 1, seed 1): pruned." in page(tmp_path / name)
    for each in (study, trial, *ids):
        runs.client.delete_run(each)


def params_of(seed):
    return [Param("seed", str(seed)), Param("training.env_steps", "400")]


def test_a_run_that_has_not_finished_takes_part_with_what_it_has(answer, runs, tmp_path):
    ids = runs.ids("sac")
    runs.client.update_run(ids[2], status="RUNNING")
    try:
        assert answer(f"--runs={','.join(ids)}", "--out=here")[0] == 0
    finally:
        runs.client.update_run(ids[2], status="FINISHED")
    assert f"Unfinished, and shown with the data so far: {ids[2][:8]} (group 1, seed 2): running." in page(
        tmp_path / "here"
    )


def test_what_a_run_has_not_kept_is_said(answer, runs, artifacts, tmp_path):
    for name in ("evaluation.json", "episode.gif", "volumes.json"):
        (artifacts / name).unlink()
    run_id = artifacts.parent.name
    assert answer(f"--runs={run_id}", "--out=alone")[0] == 0
    shown = page(tmp_path / "alone")
    for name in ("evaluation.json", "episode.gif"):
        assert f"No {name} is among the artifacts of {run_id[:8]} (group 1, seed 0)." in shown
    assert "None of these runs has kept a final evaluation." in shown
    assert "None of these runs has kept a video." in shown
    assert answer(f"--runs={','.join(runs.ids('sac'))}", "--out=all")[0] == 0
    assert rows(tmp_path / "all" / "final.csv")[0]["seeds"] == "2"


def without_test(text):
    return json.dumps({"training volumes": json.loads(text)["training volumes"]})


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "[]",
        without_test,
        lambda text: text.replace('"n_steps"', '"steps"'),
        lambda text: text.replace('"n_steps": ', '"n_steps": "many", "of": '),
        lambda text: text.replace('"distance_mm": ', '"distance_mm": NaN, "of": '),
        lambda text: text.replace('"n_steps": ', '"n_steps": 1'),
    ],
    ids=["torn", "list", "split", "field", "word", "nan", "another run's"],
)
def test_a_damaged_evaluation_is_refused_in_one_line(answer, artifacts, tmp_path, damage):
    file = artifacts / "evaluation.json"
    file.write_text(damage(file.read_text()))
    code, _, errors = answer(f"--runs={artifacts.parent.name}")
    line = f"error: run {artifacts.parent.name}: its evaluation.json is damaged; put it back, or leave the run out"
    assert (code, errors) == (2, line)
    assert not list(tmp_path.iterdir())


def test_report_of_runs_answers_mistakes_in_one_line(answer, runs, tmp_path):
    evaluation = runs.made("evaluation", **{"evaluation.of": runs.ids("sac")[0]})
    other = runs.made("other")
    beginning = next(each for each in "0123456789abcdef" if sum(run.info.run_id[0] == each for run in runs.all) == 0)
    words_and_lines = [
        (["--runs="], "--runs is '', but it must be IDs of runs"),
        (["--runs=,"], "--runs is ',', but it must be IDs of runs, or experiment:NAME, with commas between"),
        (["--runs=experiment:"], "--runs is 'experiment:', but it must be IDs of runs"),
        (["--runs=a", "--study=b"], "--study and --runs are both given, but a report is of one of them"),
        (["--runs=a", "--storage=b"], "--storage is given, but it is for --study, and this report is of --runs"),
        (["--runs=xyz"], "the run is 'xyz', but it must be an ID as MLflow shows it"),
        (["--runs=" + beginning * 30], f"the run is '{beginning * 30}', but no run of sqlite:///"),
        (["--runs=experiment:nobody"], "the experiment is 'nobody', but in 'sqlite:///"),
        (["--runs=experiment:Default"], "the experiment is 'Default', but in 'sqlite:///"),
        (
            [f"--runs={evaluation}"],
            f"run {evaluation} is an evaluation, but runs are compared: name the run that it evaluates",
        ),
        ([f"--runs={other}"], f"run {other} (other) is not an armscan training, and has none below it"),
        (["--runs=a", "--tracking=sqlite:///nowhere.db"], "tracking.uri is 'sqlite:///nowhere.db', but there is no "),
        (
            ["--runs=a", "--out=/dev/null/a"],
            "--out is '/dev/null/a', but /dev/null is not a folder: name one",
        ),
    ]
    for words, line in words_and_lines:
        assert_refused(answer(*words), line)
    file = tmp_path / "there.txt"
    file.write_text("mine")
    refused = answer(f"--runs={runs.ids('sac')[0]}", f"--out={file}")
    assert_refused(refused, f"--out is '{file}', but {file} is not a folder")
    assert [each.read_text() for each in tmp_path.iterdir()] == ["mine"]


def test_a_beginning_that_several_runs_have_is_refused(answer, runs):
    ids = [each.info.run_id for each in runs.all] + [runs.made(f"made {number}") for number in range(17)]
    beginning = next(each for each in "0123456789abcdef" if sum(run_id[0] == each for run_id in ids) > 1)
    assert "but that may be " in answer(f"--runs={beginning}")[2]


def test_report_needs_no_server_and_no_network(answer, runs, tmp_path, browser):
    pictures = Path(os.environ.get("ARMSCAN_SCREENSHOTS", tmp_path / "screenshots")).absolute()
    assert answer(f"--runs={','.join(run.info.run_id for run in runs.all)}", "--out=here")[0] == 0
    browser.open((tmp_path / "here" / "report.html").as_uri())
    # Bands and lines of two groups with three seeds in three figures, and beside them those of the training.
    assert browser.count(".js-plotly-plot", at_least=3) == 3
    browser.count(".js-plotly-plot:first-of-type .scatterlayer .trace", at_least=2 * 3 * 6)
    lines = "return document.querySelector('.js-plotly-plot').data.map((line) => line.x[line.x.length - 1])"
    steps = browser.driver.execute_script(lines)
    browser.click("body > .chart .updatemenu-button", text="by seconds of training")
    assert browser.driver.execute_script(lines) != steps
    assert min(steps) >= 100
    browser.keep(pictures / "report.png")
    browser.click("#start")
    assert browser.picture(".videos figure:last-of-type img") > 0
    browser.click("summary", text="Metrics of the training itself: losses, returns, speed")
    assert browser.find("details .main-svg").size["width"] > 500
    for width in (1600, 1160, 390):
        assert browser.wider_than_page(width) == []
    requests = "return performance.getEntriesByType('resource').map((each) => each.name)"
    addresses = browser.driver.execute_script(requests)
    assert not [address for address in addresses if not address.startswith(("blob:", "data:"))]
    assert not [entry for entry in browser.driver.get_log("browser") if entry["level"] == "SEVERE"]
