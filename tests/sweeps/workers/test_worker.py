"""A worker and its trials, without training: what they draw, and what becomes of those that fail."""

import errno
import os
import shutil
import threading
import time
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import optuna
import pytest

from armscan.errors import FolderInUseError, InvalidValueError
from armscan.sweeps.scheduling.claim import PlannedTrial
from armscan.sweeps.scheduling.limits import LimitReachedError, Limits
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.scheduling.state import CONTROL
from armscan.sweeps.space.space import Space
from armscan.sweeps.stop import stop_study, stop_trial
from armscan.sweeps.storage.attribute_names import FINAL_SEED, FINALIST, LEASE, METRICS, RUN, STOP
from armscan.sweeps.storage.reports import reports_of
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.phase import Phase
from armscan.sweeps.study.pruners import ParetoPruner
from armscan.sweeps.study.study import best_trials
from armscan.sweeps.tasks.folders import trial_folder
from armscan.sweeps.workers import heartbeat, worker
from armscan.sweeps.workers.heartbeat import Heartbeat
from armscan.sweeps.workers.worker import Worker
from armscan.tracking import TrackedRun, open_store
from armscan.utils.processes import ProcessInfo
from armscan.utils.run_files import LAST_CHECKPOINT
from tests.support.waiting import HANG_S

SPACE = {"agent.lr": {"low": 1e-4, "high": 1e-2, "log": True}, "agent.batch_size": {"choices": [64, 128, 256]}}
TPE = {"_target_": "optuna.samplers.TPESampler", "n_startup_trials": 2, "multivariate": True}
RANDOM = {"_target_": "optuna.samplers.RandomSampler"}


def far_from_a_thousandth(attempt):
    config, _ = attempt.config(attempt.seeds[0])
    return {"mean_steps": abs(config.agent.lr - 1e-3)}


@pytest.fixture
def make_phase(tmp_path, empty_database):
    """Return a function that makes a study in a folder, and returns its phase."""

    def make(
        folder,
        run=far_from_a_thousandth,
        *,
        sampler=RANDOM,
        seed=0,
        objectives=("mean_steps",),
        name="a",
        plan=None,
        **limits,
    ):
        folder = tmp_path / folder
        storage = open_storage(str(folder / "optuna.journal"))
        pruner = ParetoPruner(100) if len(objectives) > 1 else None
        study = optuna.create_study(
            study_name=name,
            storage=storage.optuna,
            load_if_exists=True,
            directions=["minimize"] * len(objectives),
            pruner=pruner,
        )
        if not (folder / "a.db").exists():
            shutil.copy(empty_database, folder / "a.db")
        store, experiment_id = open_store(
            f"sqlite:///{folder}/a.db", experiment="a", artifacts=str(folder / "b"), wait_s=60.0
        )
        # As each start of a study finds it.
        there = store.search_runs([experiment_id], "tags.kind = 'study'")
        own = there[0] if there else store.create_run(experiment_id, name="study", tags={"kind": "study"})
        return Phase(
            name=name,
            scheduler=TrialScheduler(study, storage, Limits(**{"n_trials": 5} | limits), plan),
            space=Space.read(SPACE),
            objectives=objectives,
            reported=objectives if pruner else (),
            run=run,
            seeds_of=lambda _: (0,),
            sampler=sampler,
            seed=seed,
            folder=folder,
            artifacts=folder / "artifacts",
            store=store,
            experiment_id=experiment_id,
            run_id=own.info.run_id,
        )

    return make


def make_heartbeat(scheduler, on_death=lambda _: None):
    return Heartbeat(scheduler, "0", should_leave=lambda: False, leave=lambda: os._exit(1), on_death=on_death)


@pytest.fixture
def work(tmp_path, make_phase):
    """Return a function that lets one worker run a study in its own folder, and returns the study."""

    def run_study(*arguments, **options):
        phase = make_phase(*arguments, **options)
        beating = make_heartbeat(phase.scheduler)
        with beating.running():
            Worker(phase, ["data.n_training=1"], beating).work()
        return phase.scheduler.study

    run_study.storage = lambda folder: open_storage(str(tmp_path / folder / "optuna.journal"))
    return run_study


@pytest.mark.parametrize("sampler", [RANDOM, TPE], ids=["random", "tpe"])
def test_worker_alone_draws_the_same_points_again_from_the_same_seed_and_others_from_another(work, sampler):
    points = [
        [trial.params for trial in work(folder, sampler=sampler, seed=seed).trials]
        for folder, seed in (("first", 0), ("again", 0), ("other", 1))
    ]
    assert points[0] == points[1]
    assert len({point["agent.lr"] for point in points[0] + points[2]}) == 10


def test_worker_prunes_a_trial_of_several_objectives_that_is_behind_in_all(work):
    def first_is_best(attempt):
        metrics = {"mean_steps": float(attempt.trial.number), "env_steps": float(attempt.trial.number)}
        for step in (50, 100):
            attempt.report(metrics, seed=0, n_env_steps=step, report_every_env_steps=50, total_env_steps=100)
        return metrics

    study = work("a", first_is_best, objectives=("mean_steps", "env_steps"), n_trials=3)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "PRUNED", "PRUNED"]
    assert reports_of(study.trials[2]) == {50: (2.0, 2.0), 100: (2.0, 2.0)}


@pytest.mark.parametrize("is_dead", [True, False], ids=["death", "interruption"])
def test_trial_that_was_to_be_pruned_is_pruned_though_its_worker_ends_before_it_tells(work, is_dead):
    ended, reported = [], []

    def first_is_best(attempt):
        metrics = dict.fromkeys(attempt.objectives, float(attempt.trial.number))
        for step in (100, 300):
            reported.append((attempt.trial.number, step))
            try:
                attempt.report(metrics, seed=0, n_env_steps=step, report_every_env_steps=100, total_env_steps=300)
            except optuna.TrialPruned:
                if attempt.trial.number != 1 or ended:
                    raise
                ended.append(step)
                if is_dead:
                    scheduler = TrialScheduler(attempt.trial.study, work.storage("a"), Limits(n_trials=3))
                    scheduler.reclaim(lambda _: True)
                    raise
                raise LimitReachedError("it was interrupted") from None
        return metrics

    study = work("a", first_is_best, objectives=("mean_steps", "env_steps"), n_trials=3)
    states = [trial.state.name for trial in study.trials]
    assert states == ["COMPLETE", *["FAIL"][:is_dead], "PRUNED", "PRUNED"]
    # No trial goes beyond the report at which it was to be pruned.
    assert {step for number, step in reported if number > 0} == {100}
    assert ended == [100]


def test_worker_goes_on_after_a_trial_that_raised_and_says_what_it_raised(work):
    seen = []

    def second_raises(attempt):
        seen.append(attempt.trial.number)
        if len(seen) == 2:
            raise RuntimeError("the second one")
        return far_from_a_thousandth(attempt)

    study = work("a", second_raises, n_trials=3)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "FAIL", "COMPLETE", "COMPLETE"]
    assert "the second one" in study.trials[1].user_attrs["failure"]
    assert Path(study.trials[1].user_attrs["folder"]).name == "0001"


def test_last_checkpoint_stays_until_the_storage_has_the_outcome_of_its_trial(work, monkeypatch):
    def trained(attempt):
        checkpoint = attempt.folder / "seed_0" / LAST_CHECKPOINT
        checkpoint.parent.mkdir(parents=True)
        checkpoint.touch()
        if attempt.trial.number == 1:
            raise RuntimeError("the second one")
        return far_from_a_thousandth(attempt)

    told, there = TrialScheduler._tell, []

    def tell(self, outcome, *, is_repeated):
        there.append((trial_folder(folder, outcome.trial.number) / "seed_0" / LAST_CHECKPOINT).exists())
        told(self, outcome, is_repeated=is_repeated)

    monkeypatch.setattr(TrialScheduler, "_tell", tell)
    folder = work.storage("a").lock_file.parent
    study = work("a", trained, n_trials=2)
    assert there == [True, True, True]
    # Only a failed trial keeps its last checkpoint.
    states = {Path(trial.user_attrs["folder"]).name: trial.state.name for trial in study.trials}
    assert states == {"0000": "COMPLETE", "0001": "FAIL", "0002": "COMPLETE"}
    assert [file.parts[-3] for file in folder.rglob(LAST_CHECKPOINT)] == ["0001"]


def test_retry_that_has_finished_removes_the_last_checkpoint_of_the_dead_attempt(work):
    def first_dies(attempt):
        checkpoint = attempt.folder / "seed_0" / LAST_CHECKPOINT
        checkpoint.parent.mkdir(parents=True)
        checkpoint.touch()
        if attempt.trial.number == 0:
            TrialScheduler(attempt.trial.study, work.storage("a"), Limits(n_trials=1)).reclaim(lambda _: True)
            assert checkpoint.exists()
        return far_from_a_thousandth(attempt)

    study = work("a", first_dies, n_trials=1)
    assert [trial.state.name for trial in study.trials] == ["FAIL", "COMPLETE"]
    assert not [*work.storage("a").lock_file.parent.rglob(LAST_CHECKPOINT)]


def test_trial_whose_folder_another_process_still_uses_is_requeued(work, monkeypatch):
    monkeypatch.setattr(worker, "WAIT_S", 0.0)
    seen = []

    def in_use_at_first(attempt):
        seen.append(attempt.trial.number)
        if len(seen) == 1:
            raise FolderInUseError("another process tracks this run")
        return far_from_a_thousandth(attempt)

    study = work("a", in_use_at_first, n_trials=1)
    assert seen == [0, 0]
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"]


def test_worker_that_cannot_read_whether_it_is_told_to_leave_asks_again(monkeypatch, make_phase):
    left = threading.Event()
    answers = iter([OSError(errno.ESTALE, "Stale file handle"), False, True])

    def should_leave():
        if isinstance(answer := next(answers, True), OSError):
            raise answer
        return answer

    monkeypatch.setattr(heartbeat, "POLL_S", 0.01)
    scheduler = make_phase("a").scheduler
    beating = Heartbeat(scheduler, "0", should_leave=should_leave, leave=left.set, on_death=lambda _: None)
    with beating.running():
        assert left.wait(HANG_S)


def test_worker_that_is_told_to_leave_while_it_opens_a_tracked_run_leaves_a_trial_that_goes_on_with_it(
    monkeypatch, make_phase
):
    told, left, start = threading.Event(), threading.Event(), TrackedRun.start

    def start_slowly(*arguments, **options):
        tracked = start(*arguments, **options)
        told.set()
        # Far longer than it takes to be told, and to requeue the trial.
        time.sleep(1.0)
        return tracked

    def leave():
        told.clear()
        left.set()
        # As if the process had exited.
        beating.opening.release()

    def run(attempt):
        assert left.wait(HANG_S)
        return far_from_a_thousandth(attempt)

    monkeypatch.setattr(heartbeat, "POLL_S", 0.01)
    for timeout in ("OPENING_TIMEOUT_S", "REQUEUE_TIMEOUT_S"):
        monkeypatch.setattr(heartbeat, timeout, HANG_S)
    monkeypatch.setattr(TrackedRun, "start", start_slowly)
    phase = make_phase("a", run, n_trials=1)
    beating = Heartbeat(phase.scheduler, "0", should_leave=told.is_set, leave=leave, on_death=lambda _: None)
    with beating.running():
        Worker(phase, ["data.n_training=1"], beating).work()
    (trial,) = phase.scheduler.study.trials
    (run,) = phase.store.runs([phase.experiment_id], "tags.trial = '0'")
    assert trial.state.name == "COMPLETE"
    assert run.info.run_id == trial.user_attrs[RUN]
    assert run.info.status == "FINISHED"
    assert run.data.tags["resumed"] == "1"


def test_worker_ends_a_study_whose_configuration_fails_at_once_and_one_with_too_many_failures(work):
    def raises(_):
        raise RuntimeError("always")

    def every_second_raises(attempt):
        if attempt.trial.number % 2:
            raise RuntimeError("odd")
        return far_from_a_thousandth(attempt)

    assert [trial.state.name for trial in work("a", raises, n_trials=100).trials] == ["FAIL"] * 3
    study = work("b", every_second_raises, n_trials=100, max_failures=4)
    assert sorted(trial.state.name for trial in study.trials) == ["COMPLETE"] * 5 + ["FAIL"] * 5


@pytest.mark.parametrize(
    ("metrics", "reason"),
    [
        (
            {"mean_steps": float("nan")},
            "what the task has returned as mean_steps is nan, but it must be",
        ),
        ({"mean_steps": -float("inf")}, "what the task has returned as mean_steps is -inf, but it must be a finite"),
        ({"mean_steps": None}, "what the task has returned as mean_steps is None, but it must be"),
        (
            {"mean_steps": 1.0, "other": "fast"},
            "what the task has returned as other is 'fast', but it",
        ),
        ({"other": 1.0}, "the task has not returned mean_steps, but only other"),
        (3.0, "the task has returned 3.0, but it must be metrics by their names"),
    ],
    ids=str,
)
def test_worker_fails_a_trial_that_returns_something_else_than_metrics(work, metrics, reason):
    study = work("a", lambda _: metrics)
    assert [trial.state.name for trial in study.trials] == ["FAIL"] * 3
    assert reason in study.trials[0].user_attrs["failure"]
    assert best_trials(study, 1) == []


OTHERS = {
    "another study's": {"study": "b", "trial": "0"},
    "another trial's": {"study": "a", "trial": "7"},
    "of a study of the same name": {"study": "a", "trial": "0", "mlflow.parentRunId": "0" * 32},
    "no trial's": {},
}


@pytest.mark.parametrize("tags", OTHERS.values(), ids=OTHERS)
def test_run_that_a_trial_names_and_that_is_anothers_is_left_as_it_is(work, tmp_path, empty_database, tags):
    (tmp_path / "a").mkdir()
    shutil.copy(empty_database, tmp_path / "a" / "a.db")
    client, experiment_id = open_store(
        f"sqlite:///{tmp_path}/a/a.db", experiment="a", artifacts=str(tmp_path / "a" / "b"), wait_s=60.0
    )
    victim = client.create_run(experiment_id, name="n", tags=tags)
    study = optuna.create_study(study_name="a", storage=work.storage("a").optuna)
    study.enqueue_trial({"agent.lr": 1e-3}, user_attrs={"mlflow_run": victim.info.run_id})
    study = work("a", n_trials=1)
    line = f"a.trials[0].user_attrs.mlflow_run names run {victim.info.run_id}, which is another's"
    assert study.trials[0].user_attrs["failure"].startswith(line)
    now = client.get_run(victim.info.run_id)
    assert (now.info.status, now.data.tags, now.data.params) == ("RUNNING", victim.data.tags, {})


def test_trial_that_a_stranger_damages_while_it_runs_ends_the_worker_in_one_line(work, capfd):
    def damaged(attempt):
        stranger = work.storage("a").optuna
        stranger.set_trial_user_attr(attempt.trial._trial_id, "seeds", "x")
        return far_from_a_thousandth(attempt)

    with pytest.raises(InvalidValueError, match=r"user_attrs.seeds is 'x', but it must be the metrics of each seed"):
        work("a", damaged)
    assert "Traceback" not in "".join(capfd.readouterr())


@pytest.mark.parametrize("raised", [SystemExit(0), KeyboardInterrupt()], ids=repr)
def test_worker_outlives_a_task_that_would_end_it(work, raised):
    def second_raises(attempt):
        if attempt.trial.number == 1:
            raise raised
        return {"mean_steps": np.float32(0.5), "other": float("nan")}

    study = work("a", second_raises, n_trials=2)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "FAIL", "COMPLETE"]


def test_worker_goes_on_with_a_broken_study_once_its_failures_are_forgiven(work):
    def raises(_):
        raise RuntimeError("a mistake that somebody mends then")

    study = work("a", raises)
    assert [trial.state.name for trial in work("a").trials] == ["FAIL"] * 3
    scheduler = TrialScheduler(study, work.storage("a"), Limits(n_trials=5))
    assert [scheduler.reset_failures(), scheduler.reset_failures()] == [3, 0]
    assert [trial.state.name for trial in work("a").trials] == ["FAIL"] * 3 + ["COMPLETE"] * 5


def test_worker_needs_of_a_report_only_what_is_pruned_by(work):
    def reports(attempt):
        attempt.report({"mean_steps": 1.0}, seed=0, n_env_steps=1, report_every_env_steps=1, total_env_steps=1)
        return {"mean_steps": 1.0}

    assert {trial.state.name for trial in work("a", reports).trials} == {"COMPLETE"}


def report_until_told_otherwise(attempt):
    """Report as a long training does."""
    until_s = time.monotonic() + HANG_S
    while time.monotonic() < until_s:
        attempt.report({"mean_return": -1.0}, seed=0, n_env_steps=100, report_every_env_steps=100, total_env_steps=1000)
        time.sleep(0.01)
    raise AssertionError


def test_stopped_trial_is_pruned_and_counts_as_finished(work, tmp_path, monkeypatch):
    monkeypatch.setattr(heartbeat, "HEARTBEAT_S", 0.05)
    journal = str(tmp_path / "a" / "optuna.journal")

    def second_is_stopped(attempt):
        if attempt.trial.number == 1:
            assert stop_trial(journal, "a", 1).startswith(
                "trial 1 of study a will end within ten seconds and an epoch, as pruned"
            )
            report_until_told_otherwise(attempt)
        return far_from_a_thousandth(attempt)

    trials = work("a", second_is_stopped, n_trials=3).trials
    assert [trial.state.name for trial in trials] == ["COMPLETE", "PRUNED", "COMPLETE"]
    assert trials[1].user_attrs["stop"].startswith("at 20")
    assert trials[1].user_attrs["env_steps"] == 100


def test_stopped_study_requeues_its_trial_and_goes_on_when_it_is_started_again(work, tmp_path, monkeypatch):
    monkeypatch.setattr(heartbeat, "HEARTBEAT_S", 0.05)
    journal = str(tmp_path / "a" / "optuna.journal")

    def stopped_in_the_second(attempt):
        if attempt.trial.number == 1:
            assert "1 running trial will be requeued" in stop_study(journal, "a")
            report_until_told_otherwise(attempt)
        return far_from_a_thousandth(attempt)

    study = work("a", stopped_in_the_second, n_trials=3)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "WAITING"]
    # Until the study is resumed, new workers do nothing.
    assert len(work("a", n_trials=3).trials) == 2
    scheduler = TrialScheduler(study, work.storage("a"), Limits(n_trials=3))
    assert scheduler.resume()
    assert not scheduler.resume()
    assert [trial.state.name for trial in work("a", n_trials=3).trials] == ["COMPLETE"] * 3


@pytest.fixture
def phases_with_training_of_another(monkeypatch, make_phase):
    """Return a function that makes phases whose selection waits for another worker's training, and what ends that."""

    def make(run_test):
        chosen = 0

        def plan():
            begun = [trial.user_attrs[FINALIST] for trial in test.scheduler.study.trials]
            known = [CONTROL] if selection.scheduler.state().running else [CONTROL, chosen]
            return [PlannedTrial({}, {FINALIST: number, FINAL_SEED: 7}) for number in known if number not in begun]

        search = make_phase("a", n_trials=1)
        selection = make_phase("a", name="a-selection", plan=list)
        test = make_phase("a", run_test, name="a-judged", plan=plan)
        lease = {"worker": "another", **asdict(ProcessInfo.current())}
        attributes = {FINALIST: chosen, FINAL_SEED: 3, LEASE: lease, METRICS: {}}
        selection.scheduler.study.enqueue_trial({}, user_attrs=attributes)
        number = selection.scheduler.study.ask().number
        opened = SimpleNamespace(phases=(search, selection, test), finals=(selection, test))
        monkeypatch.setattr(worker, "read_settings", lambda words: ())
        monkeypatch.setattr(worker, "open_for_work", lambda *_, **options: opened)
        return opened, lambda: selection.scheduler.study.tell(number, 1.0)

    return make


def test_worker_tests_the_control_while_another_has_the_last_training_of_the_selection(
    phases_with_training_of_another,
):
    seen = []

    def run_test(attempt):
        seen.append((attempt.trial.user_attrs[FINALIST], len(opened.finals[0].scheduler.state().running)))
        if len(seen) == 1:
            end_training()
        return {"mean_steps": 1.0}

    opened, end_training = phases_with_training_of_another(run_test)
    worker.work(["data.n_training=1"], make_heartbeat)
    assert seen == [(CONTROL, 1), (0, 0)]
    assert [len(phase.scheduler.state().finished) for phase in opened.phases] == [1, 1, 2]


def test_worker_tests_nothing_once_the_study_is_stopped(monkeypatch, phases_with_training_of_another):
    opened, end_training = phases_with_training_of_another(lambda attempt: {"mean_steps": 1.0})
    opened.finals[0].scheduler.study.set_user_attr(STOP, "by somebody")
    # Called where a worker waits.
    monkeypatch.setattr(worker, "time", SimpleNamespace(sleep=lambda _: end_training()))
    worker.work(["data.n_training=1"], make_heartbeat)
    assert [len(phase.scheduler.state().all) for phase in opened.phases] == [1, 1, 0]
