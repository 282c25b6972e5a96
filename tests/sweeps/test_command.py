"""Studies as a user starts them: real workers, killed and interrupted, on phantoms."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import optuna
import pytest
from hydra.errors import HydraException
from optuna.artifacts import get_all_artifact_meta
from optuna_dashboard import get_note
from optuna_dashboard._note import get_note_from_system_attrs
from yaml import YAMLError

from armscan.config.error_messages import one_line_message
from armscan.errors import ArmscanError, InvalidValueError, StudyError
from armscan.sweeps.command import run_study
from armscan.sweeps.storage.storage import open_storage
from armscan.tracking import open_existing_store
from armscan.tracking.tags import JOB_TAG
from armscan.utils.files import sha256
from armscan.utils.run_files import RESULT_SHA256_TAGS, RUN_FILE
from tests.reports.conftest import rows
from tests.support import FEW_VOLUMES
from tests.support.processes import processes_in, start_run
from tests.support.waiting import HANG_S, wait_until
from tests.test_run import armscan_run, runs_in
from tests.training.test_result_table import recomputed

TINY = [
    *("-m", "sweep=sac_y", *FEW_VOLUMES, "training.env_steps=400"),
    *(
        "training.eval_every_env_steps=200",
        "training.validation_episodes=2",
        "evaluation.episodes=3",
        "env.max_steps=8",
    ),
    *("agent.learning_starts=100", "agent.batch_size=32", "network.vector.hidden_sizes=[16]", "study/pruner=none"),
    *(
        "study.final_eval.top_k=1",
        "study.final_eval.min_seeds=1",
        "study.final_eval.mean_seeds=1",
        "study.final_eval.test_seeds=1",
        "study.final_eval.episodes=4",
    ),
]


class LossTask:
    """A task whose final metric is of no test."""

    metrics = check = run = validate = evaluate = None
    final_metric = "loss"


def trials_of(folder, name="sac_y"):
    storage = open_storage(str(folder / "optuna.journal"))
    if name not in optuna.get_all_study_names(storage.optuna):
        return []
    return optuna.load_study(study_name=name, storage=storage.optuna).trials


def workers_in(folder):
    files = folder.glob("studies/sac_y/workers/*/worker-*.json")
    return [json.loads(file.read_text())["pid"] for file in files]


def run_id_in(folder):
    return json.loads((folder / RUN_FILE).read_text())["run_id"]


def check_result(folder):
    """Compare the result in the report with its episodes, by NumPy alone."""
    report = [sys.executable, "-m", "armscan", "report", "--study", "sac_y", "--out", "report"]
    subprocess.run(report, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    of_agents = [row for row in rows(folder / "report" / "result.csv") if row["of"] == "agent"]
    printed = {(row["trial"], row["metric"].removeprefix("test/")): float(row["value"]) for row in of_agents}
    episodes = {}
    for trial in trials_of(folder, "sac_y-judged"):
        name = "control" if trial.user_attrs["judged"] < 0 else str(trial.user_attrs["judged"])
        (file,) = (folder / trial.user_attrs["folder"]).glob("seed_*/evaluation.json")
        tags = open_existing_store(f"sqlite:///{folder}/mlruns.db").get_run(run_id_in(file.parent)).data.tags
        assert tags[RESULT_SHA256_TAGS[file.name]] == sha256(file.read_bytes())
        assert JOB_TAG not in tags
        of_seed = json.loads(file.read_text())["test volumes"]["episodes"]
        episodes.setdefault(name, []).extend(SimpleNamespace(**each) for each in of_seed)
    assert "control" in episodes
    for name, of_seeds in episodes.items():
        expected = recomputed(of_seeds)
        assert {key: printed[name, key] for key in expected} == pytest.approx(expected)


def check_values(folder, runs):
    """Check that the value of each trial is of the episodes after its training, more of them in the selection."""
    values = {study: [trial.value for trial in trials_of(folder, study)] for study in ("sac_y", "sac_y-selection")}
    trained = [run for run in runs if run.data.tags.get("study") in values and "seed" in run.data.params]
    assert len(trained) == sum(map(len, values.values()))
    for run in trained:
        study = run.data.tags["study"]
        assert run.data.metrics["selection/mean_steps"] == values[study][int(run.data.tags["trial"])]
        assert run.data.params["evaluation.episodes"] == ("3" if study == "sac_y" else "4")


@pytest.mark.full
@pytest.mark.usefixtures("database")
def test_study_runs_its_trials_tests_the_best_and_goes_on_when_it_is_asked_for_more(tmp_path, monkeypatch):
    ended = armscan_run(*TINY, "study.n_trials=2", cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ""
    # Two trials of the search, then the best of them and the control.
    assert ended.stdout.count(" done: mean_steps ") == 4
    for line in (
        "selection of control with seed 1000 done: ",
        "test of control with seed 2000 done: ",
        "result: ",
    ):
        assert line in ended.stdout
    check_result(tmp_path)
    client, runs = runs_in(tmp_path)
    check_values(tmp_path, runs)
    by_id = {each.info.run_id: each for each in runs}
    assert {each.info.status for each in runs} == {"FINISHED"}
    # Only the trainings of the test keep their policies.
    kept = [each.data.tags["folder"] for each in runs if each.data.tags.get("policy") == "kept"]
    assert sorted(kept) == sorted(str(model.parent.parent) for model in tmp_path.glob("studies/**/MLmodel"))
    assert all("/judged/" in folder for folder in kept)
    assert len(kept) == len(trials_of(tmp_path, "sac_y-judged"))
    # They alone have a film.
    assert sorted(str(film.parent) for film in tmp_path.glob("studies/**/episode.gif")) == sorted(kept)
    # They alone have a model in MLflow. The study's run has the result, beside the random agent.
    models = client.search_logged_models([runs[0].info.experiment_id])
    assert sorted(by_id[each.source_run_id].data.tags["folder"] for each in models) == sorted(kept)
    storage = open_storage(str(tmp_path / "optuna.journal")).optuna
    (study_run,) = [each for each in runs if each.info.run_name == "study sac_y"]
    note = study_run.data.tags["mlflow.note.content"]
    assert "| random |" in note
    # On the dashboard's page of the study, too.
    assert get_note(optuna.load_study(study_name="sac_y", storage=storage)).endswith(note)
    assert {"random/mean_steps", "test_volumes/mean_steps"} <= study_run.data.metrics.keys()
    for trial in trials_of(tmp_path):
        # Trial, run, folder and configuration refer to each other.
        tracked = by_id[trial.user_attrs["mlflow_run"]]
        assert tracked.data.tags["mlflow.parentRunId"] == study_run.info.run_id
        assert tracked.data.tags["trial"] == str(trial.number)
        assert tracked.data.tags["folder"] == str(tmp_path / trial.user_attrs["folder"])
        assert tracked.data.tags["config.sha256"] == trial.user_attrs["config_sha256"]
        assert tracked.data.metrics["mean_steps"] == trial.value
        assert float(tracked.data.params["agent.lr"]) == trial.params["agent.lr"]
        (training,) = [each for each in runs if each.data.tags.get("mlflow.parentRunId") == tracked.info.run_id]
        assert float(training.data.params["agent.lr"]) == trial.params["agent.lr"]
        assert training.data.tags["folder"].startswith(tracked.data.tags["folder"])
        assert trial.intermediate_values.keys() == {200, 400}
        # What Optuna's dashboard shows of it.
        (picture,) = get_all_artifact_meta(trial, storage=storage)
        assert (tmp_path / "optuna.artifacts" / picture.artifact_id).read_bytes().startswith(b"\x89PNG")
        notes = storage.get_study_system_attrs(storage.get_study_id_from_name("sac_y"))
        link = f"http://127.0.0.1:5000/#/experiments/{tracked.info.experiment_id}/runs/{tracked.info.run_id}"
        assert link in get_note_from_system_attrs(notes, trial._trial_id)["body"]
    assert len({trial.params["agent.lr"] for trial in trials_of(tmp_path)}) == 2
    # The volumes are those of the command; its workers know none.
    assert "study.volumes.test" in optuna.load_study(study_name="sac_y", storage=storage).user_attrs["fixed_config"]
    again = armscan_run(*TINY, "study.n_trials=3", "study.final_eval.top_k=0", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert [trial.state.name for trial in trials_of(tmp_path)] == ["COMPLETE"] * 3
    monkeypatch.chdir(tmp_path)
    with pytest.raises(StudyError, match=r"validation_episodes was 2, is 3; accept that with study\.allow_config"):
        run_study([*TINY, "study.n_trials=4", "training.validation_episodes=3"], launch=pytest.fail)
    assert len(trials_of(tmp_path)) == 3


def unwrapped(printed):
    return " ".join(printed.split())


@pytest.mark.slow
def test_study_ends_by_itself_where_the_noise_between_seeds_is_larger_than_what_may_be_gained(tmp_path):
    words = [*TINY, "study/terminator=noise", "study.terminator.min_trials=4", "study.seeds=[0,1]", "study.workers=1"]
    words += ["study.objectives=[maximize mean_return]", "study.n_trials=30", "study.final_eval.top_k=0"]
    ended = armscan_run(*words, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    trials = trials_of(tmp_path)
    assert 4 <= len(trials) < 30
    reason = (
        r"after \d+ trials, further ones may gain at most (\S+) in mean_return, and the noise between seeds is ([\d.]+)"
    )
    told = re.search(f"the study has ended early: ({reason})", unwrapped(ended.stdout))
    assert float(told[2]) < float(told[3])
    # The plan gives the same reason, and the same command prints the same result without a worker.
    plan = unwrapped(armscan_run(*words, "--plan", cwd=tmp_path).stdout)
    assert told[1] in plan
    assert "the rest nothing: the study has finished" in " ".join(plan.split())
    again = armscan_run(*words, cwd=tmp_path)
    assert again.returncode == 0
    assert again.stdout.partition("best while searching")[2] == ended.stdout.partition("best while searching")[2] != ""
    assert len(workers_in(tmp_path)) == 1
    assert [trial.number for trial in trials_of(tmp_path)] == [trial.number for trial in trials]


@pytest.mark.slow
def test_study_survives_a_killed_worker_and_hands_its_trials_back_when_it_is_interrupted(tmp_path):
    words = [*TINY, "study.n_trials=2", "study.final_eval.top_k=0", "training.env_steps=200000"]
    process = start_run(*words, cwd=tmp_path)

    def have_reported(n_trials):
        return sum(len(trial.intermediate_values) > 3 for trial in trials_of(tmp_path)) == n_trials

    wait_until(lambda: have_reported(2), process=process)
    os.kill(workers_in(tmp_path)[0], signal.SIGKILL)
    # The retry has the reports of the first attempt before a worker claims it.
    wait_until(lambda: have_reported(3) and trials_of(tmp_path)[2].params, process=process)
    (dead,) = [trial for trial in trials_of(tmp_path) if trial.state.name == "FAIL"]
    retry = trials_of(tmp_path)[2]
    assert "its worker died" in dead.user_attrs["failure"]
    assert retry.user_attrs["retry_of"] == dead.number
    assert retry.params == dead.params
    # What the first attempt has reported, the second has from its checkpoint.
    common = dead.intermediate_values.keys() & retry.intermediate_values.keys()
    assert len(common) > 3
    assert all(retry.intermediate_values[step] == dead.intermediate_values[step] for step in common)

    at_s = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(HANG_S) == 130
    # Five seconds on an idle machine; the trials would go on for many minutes.
    assert time.monotonic() - at_s < 60
    assert processes_in(tmp_path) == []
    assert sorted(trial.state.name for trial in trials_of(tmp_path)) == ["FAIL", "WAITING", "WAITING"]
    assert "RUNNING" not in {each.info.status for each in runs_in(tmp_path)[1]}
    printed = (tmp_path / "printed").read_text()
    assert printed.endswith("interrupted; the same command resumes the study\n")
    assert "Traceback" not in printed


@pytest.mark.slow
@pytest.mark.usefixtures("database")
def test_run_of_a_study_is_running_while_one_of_two_commands_works_and_killed_once_it_is_stopped(tmp_path):
    words = [*TINY, "study.n_trials=2", "study.workers=1", "study.final_eval.top_k=0", "training.env_steps=200000"]

    def of_study():
        (run,) = [run for run in runs_in(tmp_path)[1] if run.info.run_name == "study sac_y"]
        return run.info.status, run.data.tags.get("failure", "")

    def report(n_trials):
        return sum(bool(trial.intermediate_values) for trial in trials_of(tmp_path)) == n_trials

    first = start_run(*words, cwd=tmp_path)
    wait_until(lambda: report(1), process=first)
    second = start_run(*words, cwd=tmp_path)
    wait_until(lambda: report(2), process=second)
    os.killpg(first.pid, signal.SIGINT)
    assert first.wait(HANG_S) == 130
    assert of_study() == ("RUNNING", "")
    assert "not everything was uploaded" not in (tmp_path / "printed").read_text()
    stop = [sys.executable, "-m", "armscan", "runs", "stop", "sac_y"]
    subprocess.run(stop, cwd=tmp_path, check=True, stdout=subprocess.DEVNULL)
    assert second.wait(HANG_S) == 0
    status, reason = of_study()
    assert status == "KILLED"
    assert reason.startswith("stopped at ")


@pytest.mark.slow
@pytest.mark.usefixtures("database")
def test_study_whose_worker_left_is_not_finished_and_a_finished_one_stays_as_it_is(tmp_path):
    words = [*TINY, "study.n_trials=3", "study.workers=1", "study.final_eval.top_k=0", "training.env_steps=3000"]

    def of_study():
        (run,) = [run for run in runs_in(tmp_path)[1] if run.info.run_name == "study sac_y"]
        return run

    process = start_run(*words, cwd=tmp_path)
    wait_until(lambda: len(trials_of(tmp_path)) == 2, process=process)
    os.kill(workers_in(tmp_path)[0], signal.SIGTERM)
    assert process.wait(HANG_S) == os.EX_TEMPFAIL
    assert (of_study().info.status, of_study().data.tags["failure"]) == (
        "KILLED",
        "its workers have ended; the same command resumes it",
    )
    assert start_run(*words, cwd=tmp_path).wait(HANG_S) == 0
    finished = of_study()
    assert finished.info.status == "FINISHED"
    assert start_run(*words, cwd=tmp_path).wait(HANG_S) == 0
    assert "nothing is left to do" in (tmp_path / "printed").read_text()
    assert of_study().to_dictionary() == finished.to_dictionary()


@pytest.mark.full
def test_interrupted_study_kills_a_worker_that_does_not_leave_and_enqueues_its_trial_again(tmp_path):
    words = [*TINY, "study.n_trials=2", "study.final_eval.top_k=0", "training.env_steps=200000"]
    process = start_run(*words, cwd=tmp_path)
    wait_until(lambda: sum(bool(trial.intermediate_values) for trial in trials_of(tmp_path)) == 2, process=process)
    os.kill(workers_in(tmp_path)[0], signal.SIGSTOP)
    os.kill(process.pid, signal.SIGINT)
    assert process.wait(HANG_S) == 130
    assert processes_in(tmp_path) == []
    assert sorted(trial.state.name for trial in trials_of(tmp_path)) == ["FAIL", "WAITING", "WAITING"]


# Words after `-m sweep=sac_y`, and a part of the answer.
MISTAKES = [
    ("sweep=sac_zy", "sweep is given 2 times, but it must be once"),
    ("resume=true", "resume is not for a study, which resumes by its own command"),
    ("hydra/launcher=foo", "hydra/launcher is 'foo', but it must be basic, joblib"),
    ("hydra.searchpath=[/nowhere]", "hydra.searchpath names '/nowhere', but there is no"),
    ("study=null", "study is a section of the configuration: give its keys, such as"),
    ("agent.lr=1,2", "'agent.lr=1,2' gives several values, but those of a study come"),
    ("seed=7", "'seed=7' has no effect in a study: study.seeds are the seeds of each trial, study.seed is that of"),
    ("study.seeds=0,1", "'study.seeds=0,1' gives several values, but a study has one"),
    ("+tracking.foo=1", "there is no key 'foo' in tracking, but only uri, experiment, artifacts, wait_s,"),
    ("study.folder=/dev/null", "study.folder is '/dev/null', but '/dev/null' is not a folder"),
    ("study.artifacts=/dev/null/a", "study.artifacts is '/dev/null/a', but '/dev/null' is"),
    ("study.space.agent.choices=[null]", "study.space: agent=null is not allowed: "),
    ("+study.foo=1", "there is no key 'foo' in study, but only "),
    ("study.n_trials=0", "study.n_trials is 0, but it must be"),
    ("study.objectives=[minimize foo]", "study.objectives names 'foo', but a trial"),
    ("study.objectives=[up mean_steps]", "study.objectives is ['up mean_steps'], but"),
    (
        "study.objectives=[minimize mean_steps,maximize mean_steps]",
        "study.objectives is ['minimize mean_steps', 'maximize mean_steps'], but it must be a list such as",
    ),
    ("study.seeds=[1,1]", "study.seeds is [1, 1], but it must be a list of at least one seed, such as"),
    ("study.seeds=0", "study.seeds is 0, but it must be a list of at least one seed"),
    ("study.seeds=[99999999999]", "study.seeds is [99999999999], but it must be a list"),
    ("study.seed=99999999999", "study.seed is 99999999999, but it must be"),
    ("+study.sampler.foo=1", "study.sampler cannot be made: TPESampler.__init__() got an"),
    ("+study.pruner.foo=1", "study.pruner cannot be made: MedianPruner.__init__() got an"),
    ("study.sampler._target_=os.getcwd", "study.sampler cannot be made: "),
    ("study.sampler._target_=collections.Counter", "but it must be a sampler of Optuna"),
    ("study.pruner._target_=collections.Counter", "but it must be a pruner of Optuna"),
    ("study.task._target_=foo.Foo", "study.task cannot be made: Error loading 'foo.Foo'"),
    ("study.task._target_=collections.Counter", "which has no metrics, as a task must"),
    (
        "study.task._target_=tests.sweeps.test_command.LossTask",
        "but it must begin with test/, as all metrics that its evaluate",
    ),
    ("study.storage=3", "study.storage is 3, but it must be a string that says where"),
    ("study.storage=''", "study.storage is '', but it must be a string that says where"),
    ("study.folder=''", "study.folder is '', but it must be a string that says where"),
    ("study.storage=/dev/null/a", "study.storage is '/dev/null/a', but no file can be"),
    ("study.storage=/dev/null/a", "--plan", "study.storage is '/dev/null/a', but no file"),
    ("study.final_eval=3", "study.final_eval is 3, but it must be a section with top_k"),
    ("study.pruner=median", "study.pruner is 'median', but it must be a section with a _target_"),
    (
        "study.objectives=[minimize mean_steps,maximize success_rate]",
        "study.pruner is optuna.pruners.MedianPruner, which compares one objective, but study.objectives has 2",
    ),
    ("study/sampler=best", "study/sampler is 'best', but it must be cmaes, "),
    ("study.name=a/b", "study.name is 'a/b', but it must begin with a letter"),
    (f"study.name={'a' * 101}", "have at most 100 characters"),
    ("study.name=a-judged", "and not end in -selection or -judged, as final"),
    (
        "study.final_eval.mean_seeds=1",
        "study.final_eval.min_seeds is 2, but it must be at most study.final_eval.mean_seeds, which is 1",
    ),
    (
        "study.final_eval.test_seeds=0",
        "study.final_eval.test_seeds is 0, but it must be a whole number from 1 to 1000",
    ),
    (
        "evaluation.episodes=1001",
        "evaluation.episodes is 1001, but final trainings must have at least as many: give also study.final_eval",
    ),
    ("study.final_eval.n_seeds=2", "study.final_eval.n_seeds has been renamed: give study.final_eval.test_seeds"),
    ("study.space=3", "study.space.agent.lr.high=0.002", "study.space.agent.lr.low is not set, but it must be"),
    ("study.workers=999", "--plan", "study.workers is 999, but this machine has "),
    ("study.workers=999", "study.workers is 999, but this machine has "),
    (
        "study.storage=postgresql://me:secret@127.0.0.1:1/db",
        "study.storage has a password in its address, where others could read it",
    ),
    (
        "study.space.agent.lrr.choices=[1]",
        "study.space: agent.lrr=1 is not allowed: there is no key 'lrr' in agent, but only ",
    ),
    (
        "+study.space={agent.tau:{low:0.5,high:7.0}}",
        "study.space: agent.tau=7.0 is not allowed: agent.tau is 7.0, but it must be",
    ),
    ("study.space={agent.lr:{choices:[1]}}", "study.space.agent.lr.choices=[...] on the command line replaces a range"),
    ("study.space.seed.choices=[1,2]", "study.space.seed: 'seed' sets how a study is run"),
    (
        "study.space.network.choices=[auto,mlp]",
        "study.space.network.vector.hidden_sizes.choices=[[8]]",
        "is not allowed: there is no key 'vector' in network, but only hidden_sizes or activation",
    ),
    (
        "+study.space.env.max_steps.choices=[5,50]",
        "env.max_steps=5 is not allowed: it is another task than the",
    ),
    (
        "+study.space.env.ends.choices=[on_budget]",
        "env.ends=on_budget is not allowed: study.objectives names",
    ),
    (
        "study.space.agent.lr.high=0.02",
        "agent.lr=0.01",
        "agent.lr is given a value, and study.space.agent.lr to search it: give one of them",
    ),
    ("study.objectives=[minimize success_rate]", "study.objectives has 'minimize success_rate', but it must be 'maxi"),
    (
        "study.constraints=['success_rate >= 95']",
        "has 'success_rate >= 95', which no trial can satisfy: success_rate is from 0 to 1",
    ),
    ("agent=random", "but the trials of this study need one that learns"),
    ("training.env_steps=-1", "training.env_steps is -1, but it must be a whole number"),
]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["sweep=sac_y"], "a study has many runs, which needs -m: python -m armscan.run -m sweep=sac_y"),
        (["sweep=sac_y", "--plan"], "a study has many runs, which needs -m: python -m armscan.run -m sweep=sac_y"),
        (["-m", "sweep=foo"], "sweep is 'foo', but it must be landmarks, pbt_sac_zy, ppo_zy, sac_full"),
        *((["-m", "sweep=sac_y", *words], line) for *words, line in MISTAKES),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_study_answers_mistakes_in_one_line_before_anything_is_there(tmp_path, monkeypatch, words, line):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ArmscanError, HydraException)) as raised:
        run_study([*words, *FEW_VOLUMES], launch=lambda _: pytest.fail("workers were launched"))
    answer = one_line_message(raised.value)
    assert answer is not None
    assert line in answer
    assert "\n" not in answer
    assert "secret" not in answer
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("contents", ["a: [", "a: 1\na: 2\n", "\xff"], ids=["syntax", "twice", "no text"])
def test_study_answers_a_damaged_file_in_one_line(tmp_path, monkeypatch, contents):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweeps").mkdir()
    (tmp_path / "sweeps" / "mine.yaml").write_bytes(contents.encode("latin-1"))
    with pytest.raises((YAMLError, UnicodeDecodeError)) as raised:
        run_study(["-m", "sweep=mine"], launch=pytest.fail)
    answer = one_line_message(raised.value)
    assert answer is not None
    assert answer.startswith("a file of the configuration cannot be read: ")


def test_study_answers_a_file_that_is_not_for_the_whole_configuration(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweeps").mkdir()
    (tmp_path / "sweeps" / "mine.yaml").write_text("study: {name: mine}\n")
    with pytest.raises(InvalidValueError, match="its first line must be '# @package _global_'"):
        run_study(["-m", "sweep=mine"], launch=pytest.fail)
