"""The report of a study: one page without a server, every number as CSV beside it."""

import base64
import json
import re
from functools import partial

import optuna
import pytest
from PIL import Image

from armscan.sweeps.results.report import _videos
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.storage.storage import open_storage
from tests.reports.conftest import rows
from tests.sweeps.conftest import fail
from tests.sweeps.study.test_final_eval import QUIET
from tests.sweeps.study.test_final_eval import run as run_final


@pytest.fixture
def answer(armscan):
    """Run `armscan report` in an empty folder; return its exit code, standard output and standard error."""
    return partial(armscan, "report")


def searched(folder, objectives, n_trials=6):
    """Make a study of trials that have finished, been pruned and failed."""
    storage = open_storage(str(folder / "optuna.journal"))
    directions = ["minimize"] * len(objectives)
    study = optuna.create_study(study_name="a", storage=storage.optuna, directions=directions)
    for name, value in (("objectives", dict.fromkeys(objectives, "minimize")), ("space", {}), ("fixed_config", {})):
        study.set_user_attr(name, value)
    for number in range(n_trials):
        trial = study.ask()
        lr = trial.suggest_float("agent.lr", 0.0, 1.0)
        trial.set_user_attr("env_steps", 100 * number)
        if len(objectives) == 1:
            trial.report(lr, 100)
        if number == 1:
            fail(TrialScheduler(study, storage, Limits(n_trials=1)), trial, "it <b>broke</b>")
        elif number == 2 and len(objectives) == 1:
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
        else:
            study.tell(trial, [lr] * len(objectives))
    return storage


def add_final_trainings(storage, folder):
    study = optuna.create_study(study_name="a-judged", storage=storage.optuna)
    for seed in range(3):
        study.enqueue_trial({}, user_attrs={"judged": 0, "judged_seed": seed})
        trial = study.ask()
        of_seed = folder / "trials" / f"seed_{seed}"
        of_seed.mkdir(parents=True)
        Image.new("L", (4, 4)).save(of_seed / "episode.gif")
        trial.set_user_attr("folder", str(folder / "trials"))
        trial.set_user_attr("figures", {"test/mean_steps": 1.5 + seed, "test/success_rate": 1.0})
        study.tell(trial, 1.5 + seed)


def page_of(answer, folder):
    assert answer("--study=a")[0] == 0
    return (folder / "reports" / "a" / "report.html").read_text()


def test_report_notes_different_versions_of_the_code(answer, tmp_path):
    storage = searched(tmp_path, ["mean_steps"])
    study = optuna.load_study(study_name="a", storage=storage.optuna)
    for version in ("c1 aa", "c2 bb"):
        trial = study.ask()
        trial.suggest_float("agent.lr", 0.0, 1.0)
        trial.set_user_attr("lease", {"code": version})
        study.tell(trial, 0.5)
    noted = "its trials had different versions of armscan&#x27;s code (commit, checksum: trials; c1 aa: 1, c2 bb: 1)"
    assert noted in page_of(answer, tmp_path)


def test_report_is_one_page_with_every_number_beside_it(answer, tmp_path):
    add_final_trainings(searched(tmp_path, ["mean_steps"]), tmp_path)
    assert answer("--study=a") == (0, "look at   reports/a/report.html\n", "")
    folder = tmp_path / "reports" / "a"
    page = (folder / "report.html").read_text()
    for heading in (
        "Result",
        "History",
        "Importance",
        "Parallel",
        "Slices",
        "While training",
        "Trials",
        "Failures",
    ):
        assert f"<h2>{heading}" in page
    assert "data:image/gif;base64," in page
    assert "it &lt;b&gt;broke&lt;/b&gt;" in page
    assert 'src="http' not in page
    trials = rows(folder / "trials.csv")
    assert [row["state"] for row in trials] == ["complete", "fail", "pruned", "complete", "complete", "complete"]
    assert trials[0]["mean_steps"] == trials[0]["agent.lr"]
    assert trials[2]["mean_steps"] == ""
    assert len(rows(folder / "reports.csv")) == 6
    assert rows(folder / "failures.csv")[0]["cause"] == "it <b>broke</b>"
    assert [(row["ending"], row["cause"], row["which"]) for row in rows(folder / "endings.csv")] == [
        ("complete", "", "0 3 4 5"),
        ("fail", "it <b>broke</b>", "1"),
        ("pruned", "behind the others at environment step 100", "2"),
    ]
    (steps, success) = rows(folder / "result.csv")
    assert (steps["metric"], float(steps["value"]), success["value"]) == ("test/mean_steps", 2.5, "1.0")
    assert float(steps["low"]) < 2.5 < float(steps["high"])
    assert [row["key"] for row in rows(folder / "importances.csv")] == ["agent.lr"]


def test_objective_env_steps_is_not_taken_for_the_steps_of_all_seeds(answer, tmp_path):
    searched(tmp_path, ["env_steps"])
    answer("--study=a")
    first, *_ = rows(tmp_path / "reports" / "a" / "trials.csv")
    assert first["env_steps"] == first["agent.lr"]
    assert first["env_steps_of_all_seeds"] == "0"


@pytest.mark.parametrize(("objectives", "n_trials"), [(["mean_steps", "env_steps"], 6), (["mean_steps"], 0)])
def test_report_of_several_objectives_or_of_nothing_yet_can_be_made(answer, tmp_path, objectives, n_trials):
    searched(tmp_path, objectives, n_trials)
    assert answer("--study=a", "--out=here")[0] == 0
    page = (tmp_path / "here" / "report.html").read_text()
    assert ("Pareto front" if n_trials else "No trial has run to its end yet") in page
    of_each = ["History", "Importance of each key", "Parallel coordinates", "Slices of the space"]
    titles = {"mean_steps": "steps, mean", "env_steps": "environment steps"}
    headings = [f"<h2>{what}: {titles[name]}</h2>" for what in of_each for name in objectives]
    assert all(heading in page for heading in headings) == (n_trials > 0)


def chart_below(page, heading):
    """Return the lines of the chart below a heading, as Plotly is given them."""
    drawn = page.partition(f"<h2>{heading}")[2]
    lines = drawn.partition("Plotly.newPlot(")[2].partition("[")[2]
    return json.JSONDecoder().raw_decode(f"[{lines}")[0]


def test_history_has_the_best_so_far_and_every_number_is_rounded(answer, tmp_path):
    add_final_trainings(searched(tmp_path, ["mean_steps"]), tmp_path)
    page = page_of(answer, tmp_path)
    points, best = chart_below(page, "History")
    assert best["name"] == "best so far"
    assert best["y"] == [min(points["y"][: end + 1]) for end in range(len(points["y"]))]
    body = page.partition("<h1>")[2]
    shown = re.sub(r"<script.*?</script>|<details.*?</details>", "", body, flags=re.DOTALL)
    # Decimals with more than four digits after the zeros.
    assert not re.findall(r"\d\.0*[1-9]\d{4,}", shown)
    (typed,) = re.findall(r"<code>agent.lr=([\d.e-]+)</code>", page)
    assert float(typed) == points["y"][0]


def test_videos_are_after_the_charts_and_pruned_trials_look_so(answer, tmp_path):
    add_final_trainings(searched(tmp_path, ["mean_steps"]), tmp_path)
    page = page_of(answer, tmp_path)
    assert page.index("<h2>Parallel") < page.index("<h2>Episodes on a test volume") < page.index("<h2>Trials")
    lines = {each["name"]: each["marker"]["symbol"][-1] for each in chart_below(page, "While training")}
    assert lines == {"finished": "circle", "pruned": "x", "failed": "circle"}


def test_videos_whose_folders_are_gone_are_told(tmp_path):
    kept = {"judged": 0, "folder": str(tmp_path / "gone")}
    trials = [optuna.create_trial(value=1.0, user_attrs=kept, system_attrs=attrs) for attrs in ({}, {"episodes": {}})]
    assert _videos(trials[:1]) == ""
    assert "None: the folders of the final trainings are not here. Their runs have episode.gif." in _videos(trials)


def test_report_shows_how_a_study_decided(answer, tmp_path, browser):
    run_final(str(tmp_path / "optuna.journal"), chance=QUIET)
    assert answer("--study=a") == (0, "look at   reports/a/report.html\n", "")
    folder = tmp_path / "reports" / "a"
    page = (folder / "report.html").read_text()
    assert "Trial 1 is better than the control (steps, mean)." in page
    of_candidates = chart_below(page, "How this study decides")
    # Dots of the seeds and a diamond with the interval, of each candidate.
    assert [len(each["x"]) > 1 for each in of_candidates] == [True, False] * 3
    assert of_candidates[0]["y"][0] == "trial 1, chosen"
    scores = rows(folder / "selection.csv")
    assert {row["candidate"]: row["outcome"] for row in scores} == {
        "1": "chosen",
        "control": "not chosen",
        "0": "not chosen",
    }
    steps, success = rows(folder / "differences.csv")
    assert (steps["chosen"], steps["metric"], success["difference"]) == ("1", "test/mean_steps", "0.0")
    assert float(steps["low"]) < float(steps["difference"]) < float(steps["high"]) < 0
    browser.open((folder / "report.html").as_uri())
    browser.count(".js-plotly-plot .main-svg", at_least=3)
    for width in (1600, 390):
        assert browser.wider_than_page(width) == []


def test_running_trials_are_listed_with_how_far_they_are(answer, tmp_path):
    study = optuna.load_study(study_name="a", storage=searched(tmp_path, ["mean_steps"]).optuna)
    trial = study.ask()
    trial.suggest_float("agent.lr", 0.0, 1.0)
    trial.report(0.5, 100)
    trial.set_user_attr("lease", {"worker": "<i>me</i>", "seed": 3, "env_steps": 12345, "return": -8.123456})
    page = page_of(answer, tmp_path)
    row = page.partition("<h2>Running now</h2>")[2].partition("</tbody>")[0]
    for cell in ("&lt;i&gt;me&lt;/i&gt;", "12,345", "-8.123"):
        assert f"<div>{cell}</div>" in row
    assert chart_below(page, "While training")[-1]["name"] == "running"


def test_report_fits_a_screen_and_a_phone(answer, tmp_path, browser):
    add_final_trainings(searched(tmp_path, ["mean_steps"], n_trials=30), tmp_path)
    assert answer("--study=a")[0] == 0
    browser.open((tmp_path / "reports" / "a" / "report.html").as_uri())
    browser.count(".js-plotly-plot .main-svg", at_least=5)
    for width in (1600, 1160, 390):
        assert browser.wider_than_page(width) == []


def test_watched_report_refreshes_until_it_is_interrupted(answer, tmp_path, monkeypatch):
    study = optuna.load_study(study_name="a", storage=searched(tmp_path, ["mean_steps"]).optuna)
    file, pages = tmp_path / "reports" / "a" / "report.html", []

    def look(seconds):
        pages.append(file.read_text())
        assert f'http-equiv="refresh" content="{seconds}"' in pages[-1]
        if len(pages) == 2:
            raise KeyboardInterrupt
        study.ask().suggest_float("agent.lr", 0.0, 1.0)

    monkeypatch.setattr("armscan.cli.report.time.sleep", look)
    assert answer("--study=a", "--watch")[0] == 130
    assert ["Running now" in page for page in pages] == [False, True]
    assert 'http-equiv="refresh"' not in file.read_text()


def test_report_needs_only_to_read_the_storage(answer, tmp_path):
    searched(tmp_path, ["mean_steps"])
    with (tmp_path / "optuna.journal").open("ab") as journal:
        journal.write(b'{"op_code": 4, "wor')
    for file in tmp_path.glob(".*"):
        file.unlink()
    assert answer("--study=a")[0] == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["optuna.journal", "reports"]
    assert (tmp_path / "optuna.journal").read_bytes().endswith(b'"wor')


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ([], "error: neither --study nor --runs is given, but a report is of one of them: give --study NAME or --runs"),
        (
            ["--study=a", "--storage=nowhere"],
            "error: --storage is 'nowhere', but there is no storage: give the one that contains",
        ),
        (
            ["--study=a", "--storage=sqlite:///nowhere.db"],
            "error: --storage is 'sqlite:///nowhere.db', but there is no storage",
        ),
        (["--study=a", "--storage=list.journal"], "error: --storage is '/"),
        (["--study=b"], "error: --study is 'b', but there is only a or foreign in '/"),
        (
            ["--study=a", "--tracking=x"],
            "error: --tracking is given, but it is for --runs, and this report is of --study",
        ),
        (["--study=../a"], "error: --study is '../a', but it must begin with a letter, a digit or _"),
        (["--study=foreign"], "error: --study is 'foreign', but that one in '/"),
        (["--study=a", "--out=/dev/null/a"], "error: --out is '/dev/null/a', but /dev/null is not a folder"),
        (["--runs=a", "--watch"], "error: --watch is given, but it is for --study, and this report is of --runs"),
        (["--study=a", "--foo=1"], "error: No such option '--foo'."),
        (["--study=a", "foo"], "error: Got unexpected extra argument (foo)"),
    ],
    ids=str,
)
def test_report_answers_mistakes_in_one_line(answer, tmp_path, words, line):
    storage = searched(tmp_path, ["mean_steps"], n_trials=1)
    optuna.create_study(study_name="foreign", storage=storage.optuna)
    (tmp_path / "list.journal").write_text('{"op_code": 9}\n[1]\n')
    there = sorted(tmp_path.iterdir())
    code, printed, errors = answer(*words)
    assert (code, printed) == (2, "")
    assert errors.startswith(line)
    assert len(errors.splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == there


def test_report_shows_no_file_that_a_strangers_folder_links_to(answer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    add_final_trainings(searched(tmp_path, ["mean_steps"]), tmp_path)
    (tmp_path / "secret").write_text("secret")
    for film in tmp_path.glob("trials/seed_*/episode.gif"):
        film.unlink()
        film.symlink_to(tmp_path / "secret")
    assert answer("--study=a", f"--storage={tmp_path}/optuna.journal")[0] == 0
    page = (tmp_path / "reports" / "a" / "report.html").read_text()
    assert base64.b64encode(b"secret").decode() not in page
