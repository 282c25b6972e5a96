"""Epochs, tests, early stop and checkpoints, with a learner that follows a script."""

import pytest

from armscan.errors import InvalidValueError
from armscan.training import (
    BEST_CHECKPOINT,
    LAST_CHECKPOINT,
    Budget,
    Episode,
    Evaluation,
    SolvedCriterion,
    load_checkpoint,
    train,
)


def evaluation_of(*lengths, success=True):
    return Evaluation(
        tuple(
            Episode(
                volume="v",
                seed=0,
                n_steps=length,
                is_success=success,
                starts_solved=False,
                episode_return=-0.5 * length,
                final_reward=0.0,
                best_reward=0.0,
                distance_mm=1.0,
                distance_deg=2.0,
                dice_bones=0.9,
                dice_tendons=0.8,
                dice_artery=0.7,
                seconds_per_plane=0.01,
            )
            for length in lengths
        )
    )


class ScriptedLearner:
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

    def weights(self):
        return {"weights": self.n_epochs}

    def load_weights(self, weights):
        self.n_epochs = weights["weights"]

    def state(self):
        return {"state": self.n_epochs}

    def load_state(self, state):
        self.n_epochs = state["state"]

    def begin(self, *, seed, bounds):
        pass

    def act(self, observation, reward):
        raise AssertionError("nobody acts here")


class Recorder:
    def __init__(self):
        self.calls = []

    def on_start(self, total_env_steps):
        self.calls.append(("start", total_env_steps))

    def on_epoch(self, report):
        self.calls.append(("epoch", report.n_env_steps, report.is_best))

    def on_end(self):
        self.calls.append(("end",))


def run(tmp_path, evaluations, **budget):
    learner, recorder = ScriptedLearner(), Recorder()
    script = iter(evaluations)
    arguments = {"env_steps": 100, "epoch_env_steps": 40, "validation_episodes": 1} | budget
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
    assert (state, facts["n_env_steps"], facts["mean_steps"]) == ({"state": 3}, 100, 5.0)
    assert [call[2] for call in recorder.calls if call[0] == "epoch"] == [True, True, False]


def test_train_prefers_success_to_few_steps(tmp_path):
    learner, *_ = run(tmp_path, [evaluation_of(50), evaluation_of(1, success=False), evaluation_of(60)])
    assert learner.n_epochs == 1


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
            Budget(env_steps=100, epoch_env_steps=40, validation_episodes=1),
            lambda: 1 / 0,
            tmp_path,
            [recorder],
        )
    assert recorder.calls[-1] == ("end",)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env_steps": 0}, r"training\.env_steps is 0"),
        ({"epoch_env_steps": "a"}, r"training\.epoch_env_steps is 'a'"),
        ({"validation_episodes": 0}, r"training\.validation_episodes is 0"),
    ],
)
def test_budget_refuses_impossible_figures(changes, message):
    with pytest.raises(InvalidValueError, match=message):
        Budget(**({"env_steps": 100, "epoch_env_steps": 40, "validation_episodes": 1} | changes))


@pytest.mark.parametrize("changes", [{"success_rate": 2}, {"mean_steps": 0.5}, {"n_epochs": 0}])
def test_solved_criterion_refuses_impossible_figures(changes):
    with pytest.raises(InvalidValueError, match=next(iter(changes))):
        SolvedCriterion(**changes)
