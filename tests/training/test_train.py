"""Epochs, tests, early stop and checkpoints, with a learner that follows a script."""

import dataclasses
import shutil

import pytest

from armscan.errors import ChangedVolumesError, CheckpointError, InvalidValueError
from armscan.training import (
    BEST_CHECKPOINT,
    LAST_CHECKPOINT,
    Budget,
    CheckpointProvenance,
    EpisodeResult,
    Evaluation,
    SolvedCriterion,
    checkpoints,
    load_checkpoint,
    resume_from_checkpoint,
    take_over_checkpoints,
    train,
)


def episode_of(n_steps=1, **changes):
    """Return the result of an episode, by default one that ends on the plane."""
    facts = {
        "volume": "v",
        "seed": 0,
        "is_success": True,
        "starts_solved": False,
        "episode_return": -0.5 * n_steps,
        "final_reward": 0.0,
        "best_reward": 0.0,
        "distance_mm": 1.0,
        "distance_deg": 2.0,
        "dice_bones": 0.9,
        "dice_tendons": 0.8,
        "dice_artery": 0.7,
        "seconds_per_plane": 0.01,
    }
    return EpisodeResult(n_steps=n_steps, **facts | changes)


def evaluation_of(*lengths, success=True, distance_mm=1.0):
    return Evaluation(tuple(episode_of(each, is_success=success, distance_mm=distance_mm) for each in lengths))


class ScriptedLearner:
    env_steps_at_once = 1

    def __init__(self):
        self.n_env_steps = 0
        self.asked = []
        self.n_epochs = 0

    def warm_up(self):
        self.n_env_steps += 10

    def learn(self, n_env_steps):
        self.asked.append(n_env_steps)
        self.n_env_steps += n_env_steps
        self.n_epochs += 1
        return {"train/length": 3.0}

    def policy(self):
        raise AssertionError("nobody asks for it here")

    def weights(self):
        return {"weights": self.n_epochs}

    def load_weights(self, weights):
        self.n_epochs = weights["weights"]

    def state(self):
        return {"state": self.n_epochs, "n_env_steps": self.n_env_steps}

    def load_state(self, state):
        self.n_epochs, self.n_env_steps = state["state"], state["n_env_steps"]

    def begin(self, *, seed, bounds):
        pass

    def act(self, observation, reward):
        raise AssertionError("nobody acts here")


class Recorder:
    def __init__(self):
        self.calls = []

    def on_start(self, total_env_steps, earlier):
        self.calls.append(("start", total_env_steps, len(earlier)))

    def on_epoch(self, report):
        self.calls.append(("epoch", report.n_env_steps, report.is_best))

    def on_end(self):
        self.calls.append(("end",))


def run(tmp_path, evaluations, **budget):
    learner, recorder = ScriptedLearner(), Recorder()
    script = iter(evaluations)
    arguments = {"env_steps": 100, "eval_every_env_steps": 40, "validation_episodes": 1} | budget
    result = train(learner, Budget(**arguments), lambda: next(script), tmp_path, [recorder])
    return learner, recorder, result


def test_train_spends_the_budget_and_not_more(tmp_path):
    learner, recorder, result = run(tmp_path, [evaluation_of(9)] * 3)
    assert learner.asked == [40, 40, 10]
    assert [report.n_env_steps for report in result.reports] == [50, 90, 100]
    assert not result.is_solved
    assert [call[0] for call in recorder.calls] == ["start", "epoch", "epoch", "epoch", "end"]


def test_train_keeps_the_best_and_the_last_and_ends_with_the_best(tmp_path):
    learner, recorder, result = run(tmp_path, [evaluation_of(9), evaluation_of(3), evaluation_of(5)])
    assert learner.n_epochs == 2
    assert result.best.n_env_steps == 90
    assert load_checkpoint(tmp_path / BEST_CHECKPOINT)[0] == {"weights": 2}
    state, facts = load_checkpoint(tmp_path / LAST_CHECKPOINT)
    assert (state, facts["n_env_steps"], facts["mean_steps"]) == ({"state": 3, "n_env_steps": 100}, 100, 5.0)
    assert [call[2] for call in recorder.calls if call[0] == "epoch"] == [True, True, False]


def test_train_prefers_success_to_few_steps(tmp_path):
    learner, *_ = run(tmp_path, [evaluation_of(50), evaluation_of(1, success=False), evaluation_of(60)])
    assert learner.n_epochs == 1


@pytest.mark.parametrize(("best_by", "best"), [("success", 1), ("distance", 2)])
def test_train_keeps_the_best_by_what_is_asked_for(tmp_path, best_by, best):
    evaluations = [evaluation_of(3), evaluation_of(3, success=False, distance_mm=0.5), evaluation_of(4)]
    learner, *_ = run(tmp_path, evaluations, best_by=best_by)
    assert learner.n_epochs == best


def test_train_stops_when_solved_often_enough_in_a_row(tmp_path):
    criterion = SolvedCriterion(success_rate=1.0, mean_steps=2.0, n_epochs=2)
    evaluations = [evaluation_of(1), evaluation_of(9), evaluation_of(2), evaluation_of(1), evaluation_of(1)]
    _, _, result = run(tmp_path, evaluations, env_steps=1000, solved=criterion)
    assert result.is_solved
    assert len(result.reports) == 4


def test_train_tells_its_callbacks_when_it_fails(tmp_path):
    recorder = Recorder()
    with pytest.raises(ZeroDivisionError):
        train(
            ScriptedLearner(),
            Budget(env_steps=100, eval_every_env_steps=40, validation_episodes=1),
            lambda: 1 / 0,
            tmp_path,
            [recorder],
        )
    assert recorder.calls[-1] == ("end",)


SCRIPT = [evaluation_of(9), evaluation_of(3, 4), evaluation_of(5), evaluation_of(2), evaluation_of(6)]
BUDGET = Budget(env_steps=210, eval_every_env_steps=40, validation_episodes=1)
PROVENANCE = CheckpointProvenance(
    run_id="r", volumes={"training": {"a": "1"}, "validation": {"b": "2"}, "test": {"c": "3"}}
)


class Killed(BaseException):
    """As by kill -9: nobody is told."""


def cut_off(folder, monkeypatch, n_writes):
    """Train until `n_writes` checkpoints are written; the next write raises `Killed`."""
    save, written = checkpoints.save_checkpoint, []

    def save_or_die(*arguments):
        if len(written) == n_writes:
            raise Killed
        written.append(arguments)
        save(*arguments)

    monkeypatch.setattr(checkpoints, "save_checkpoint", save_or_die)
    recorder, script = Recorder(), iter(SCRIPT)
    with pytest.raises(Killed):
        train(ScriptedLearner(), BUDGET, lambda: next(script), folder, [recorder], provenance=PROVENANCE)
    monkeypatch.setattr(checkpoints, "save_checkpoint", save)
    return recorder


def gone_on(folder):
    """Resume a training; return its callback and its result."""
    learner, recorder = ScriptedLearner(), Recorder()
    earlier = resume_from_checkpoint(learner, folder, PROVENANCE)
    script = iter(SCRIPT[len(earlier) :])
    return recorder, train(
        learner, BUDGET, lambda: next(script), folder, [recorder], provenance=PROVENANCE, earlier=earlier
    )


def course_of(reports):
    return [dataclasses.replace(report, wall_s=0.0) for report in reports]


@pytest.mark.parametrize("n_writes", range(8))
def test_training_killed_between_any_two_writes_ends_as_if_it_had_not_been(tmp_path, monkeypatch, n_writes):
    (tmp_path / "whole").mkdir()
    (tmp_path / "cut").mkdir()
    _, whole = gone_on(tmp_path / "whole")
    cut_off(tmp_path / "cut", monkeypatch, n_writes)
    recorder, result = gone_on(tmp_path / "cut")
    assert course_of(result.reports) == course_of(whole.reports)
    assert result.best.epoch == whole.best.epoch == 4
    for name in (BEST_CHECKPOINT, LAST_CHECKPOINT):
        (state, facts), (other, others) = (load_checkpoint(tmp_path / way / name) for way in ("cut", "whole"))
        assert state == other
        assert facts["epoch"] == others["epoch"]
    n_epochs_before = recorder.calls[0][2]
    assert [call[0] for call in recorder.calls] == ["start", *["epoch"] * (5 - n_epochs_before), "end"]


def test_training_that_has_ended_goes_on_to_nothing_but_its_best_weights(tmp_path):
    _, first = gone_on(tmp_path)
    recorder, result = gone_on(tmp_path)
    assert recorder.calls == [("start", 210, 5), ("end",)]
    assert result.reports == first.reports
    assert result.wall_s >= first.reports[-1].wall_s


def test_training_that_goes_on_counts_epochs_that_had_solved_the_task(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.training.test_train.SCRIPT", [evaluation_of(9), *[evaluation_of(1)] * 4])
    cut_off(tmp_path, monkeypatch, 4)
    learner = ScriptedLearner()
    earlier = resume_from_checkpoint(learner, tmp_path, PROVENANCE)
    assert len(earlier) == 2
    budget = dataclasses.replace(BUDGET, solved=SolvedCriterion(n_epochs=2))
    result = train(learner, budget, lambda: evaluation_of(1), tmp_path, provenance=PROVENANCE, earlier=earlier)
    assert result.is_solved
    assert len(result.reports) == 3


def test_wall_time_goes_on_without_the_time_in_between(tmp_path, monkeypatch):
    cut_off(tmp_path, monkeypatch, 4)
    earlier = resume_from_checkpoint(ScriptedLearner(), tmp_path, PROVENANCE)
    long_ago = [dataclasses.replace(report, wall_s=1000.0 * report.epoch) for report in earlier]
    learner, script = ScriptedLearner(), iter(SCRIPT[2:])
    learner.n_env_steps = earlier[-1].n_env_steps
    result = train(learner, BUDGET, lambda: next(script), tmp_path, provenance=PROVENANCE, earlier=long_ago)
    assert 2000.0 < result.reports[2].wall_s < 2100.0
    assert 2000.0 < result.wall_s < 2100.0


@pytest.mark.parametrize(
    ("provenance", "message"),
    [
        ({"run_id": "other"}, r"last\.pt: is a checkpoint of run 'r', but this is 'other'"),
        ({"volumes": {"training": {"a": "9"}}}, r"the training volumes are not those .*: a is changed"),
        ({"volumes": {"validation": {"b": "2", "d": "4"}}}, r"the validation volumes are not those .*: d is new"),
        ({"volumes": {"test": {}}}, r"the test volumes are not those .*: c is not there any more"),
    ],
)
def test_take_up_refuses_what_comes_from_something_else(tmp_path, provenance, message):
    gone_on(tmp_path)
    with pytest.raises((CheckpointError, ChangedVolumesError), match=message):
        resume_from_checkpoint(ScriptedLearner(), tmp_path, dataclasses.replace(PROVENANCE, **provenance))


def test_take_up_refuses_a_best_checkpoint_that_is_missing_or_not_the_best(tmp_path):
    gone_on(tmp_path)
    (tmp_path / BEST_CHECKPOINT).unlink()
    with pytest.raises(CheckpointError, match=r"best\.pt: there is no such checkpoint"):
        resume_from_checkpoint(ScriptedLearner(), tmp_path, PROVENANCE)
    shutil.copy(tmp_path / LAST_CHECKPOINT, tmp_path / BEST_CHECKPOINT)
    with pytest.raises(CheckpointError, match=r"best\.pt: is of epoch 5, but the best epoch of .*last\.pt is 4"):
        resume_from_checkpoint(ScriptedLearner(), tmp_path, PROVENANCE)


@pytest.mark.parametrize("text", [None, "", "[]", "[1]", '[{"epoch": 1}]', '{"a": 1}'])
def test_take_up_refuses_a_checkpoint_without_its_course(tmp_path, text):
    checkpoints.save_checkpoint(tmp_path / LAST_CHECKPOINT, {}, PROVENANCE.facts() | {"reports": text})
    with pytest.raises(CheckpointError, match="holds no reports of the epochs so far"):
        resume_from_checkpoint(ScriptedLearner(), tmp_path, PROVENANCE)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env_steps": 0}, r"training\.env_steps is 0"),
        ({"eval_every_env_steps": "a"}, r"training\.eval_every_env_steps is 'a'"),
        ({"validation_episodes": 0}, r"training\.validation_episodes is 0"),
    ],
)
def test_budget_refuses_impossible_figures(changes, message):
    with pytest.raises(InvalidValueError, match=message):
        Budget(**({"env_steps": 100, "eval_every_env_steps": 40, "validation_episodes": 1} | changes))


@pytest.mark.parametrize("changes", [{"success_rate": 2}, {"mean_steps": 0.5}, {"n_epochs": 0}])
def test_solved_criterion_refuses_impossible_figures(changes):
    with pytest.raises(InvalidValueError, match=next(iter(changes))):
        SolvedCriterion(**changes)


def test_training_that_ends_early_goes_on_in_another_folder_as_its_own(tmp_path):
    first, second, script = tmp_path / "first", tmp_path / "second", [evaluation_of(each) for each in (9, 3, 5, 4)]
    for folder in (first, second):
        folder.mkdir()
    budget = Budget(env_steps=150, eval_every_env_steps=40, validation_episodes=1)
    theirs, own = (CheckpointProvenance(run_id=each) for each in ("a", "b"))
    of_first = iter(script)
    train(ScriptedLearner(), budget, lambda: next(of_first), first, provenance=theirs, until_env_steps=80)
    kept = {file.name: file.read_bytes() for file in first.iterdir()}
    learner = ScriptedLearner()
    reports = take_over_checkpoints(learner, first, second, theirs=theirs, own=own)
    # If it is killed here, it is resumed from its own checkpoints.
    learner = ScriptedLearner()
    assert resume_from_checkpoint(learner, second, own) == reports
    assert (learner.n_env_steps, [report.n_env_steps for report in reports]) == (90, [50, 90])
    result = train(learner, budget, lambda: next(of_first), second, provenance=own, earlier=reports)
    assert [report.n_env_steps for report in result.reports] == [50, 90, 130, 150]
    assert result.best.epoch == 2
    assert load_checkpoint(second / BEST_CHECKPOINT)[1]["run_id"] == "b"
    assert {file.name: file.read_bytes() for file in first.iterdir()} == kept
    with pytest.raises(CheckpointError, match="is a checkpoint of run 'a', but this is 'b'"):
        take_over_checkpoints(ScriptedLearner(), first, second, theirs=own, own=own)
    shutil.copyfile(second / LAST_CHECKPOINT, second / BEST_CHECKPOINT)
    with pytest.raises(CheckpointError, match=r"best\.pt: is of epoch 4, but the best epoch of .*last\.pt is 2"):
        take_over_checkpoints(ScriptedLearner(), second, first, theirs=own, own=own)


def test_callbacks_that_have_started_end_although_a_later_one_cannot_start(tmp_path):
    class Broken(Recorder):
        def on_start(self, total_env_steps, earlier):
            raise RuntimeError("no start")

    recorder = Recorder()
    budget = Budget(env_steps=100, eval_every_env_steps=40, validation_episodes=1)
    with pytest.raises(RuntimeError, match="no start"):
        train(ScriptedLearner(), budget, lambda: evaluation_of(9), tmp_path, [recorder, Broken()])
    assert recorder.calls == [("start", 100, 0), ("end",)]
