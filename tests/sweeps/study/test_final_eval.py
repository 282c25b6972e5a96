"""The final evaluation of a study: decided from the storage alone; exact numbers of trainings even if workers die."""

import math
import random
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import optuna
import pytest
from optuna.trial import TrialState

from armscan.errors import InvalidValueError, StudyError
from armscan.stats.bootstrap import Estimate
from armscan.stats.paired import paired_difference
from armscan.sweeps.results import difference as difference_module
from armscan.sweeps.results.csv_tables import _ending_rows
from armscan.sweeps.results.difference import Difference
from armscan.sweeps.results.progress import final_line
from armscan.sweeps.results.selection import candidates_of
from armscan.sweeps.results.study_result import StudyResult, study_result
from armscan.sweeps.results.study_run import COMPARISONS, best_metrics, result_note
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.population import searched_values
from armscan.sweeps.scheduling.scheduler import NOT_NEEDED, TrialScheduler
from armscan.sweeps.scheduling.state import CONTROL
from armscan.sweeps.stop import stop_trial
from armscan.sweeps.storage.attribute_names import FINAL_SEED, FINALIST, GENERATION, MEMBER, METRICS, SCHEDULE
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.candidates import training_of
from armscan.sweeps.study.final_eval import n_trainings
from armscan.sweeps.study.final_eval_storage import open_final_eval, stored_final_eval
from armscan.sweeps.study.plan import final_trainings_left, hours_left
from armscan.sweeps.study.settings import FinalEvalSettings
from armscan.sweeps.study.study import make_study
from tests.sweeps.conftest import fail
from tests.sweeps.study.test_study import settings

FINAL_EVAL = {"top_k": 2, "min_seeds": 2, "mean_seeds": 4, "test_seeds": 3, "episodes": 9}
# Mean steps of each configuration on all volumes: the luckiest trial of the search is not the best.
TRUE = {CONTROL: 6.0, 0: 5.0, 1: 3.0, 2: 9.0}
LUCK = {0: 1.0, 1: 2.0, 2: 9.0}
# No worker dies, and trainings end in order.
QUIET = SimpleNamespace(random=lambda: 1.0, randrange=lambda n: 0)


@pytest.fixture
def storage_uri(tmp_path):
    return str(tmp_path / "a.journal")


def searched(uri, objectives=("mean_steps",), fixed=None, constraints=(), **changes):
    """Make a study whose search has ended; return its storage, settings and study."""
    asked = settings(
        storage=uri,
        objectives=dict.fromkeys(objectives, "minimize"),
        constraints=constraints,
        allow_config_changes=True,
        final_eval=FinalEvalSettings(**FINAL_EVAL | changes),
    )
    storage = open_storage(uri)
    search = make_study(storage, asked, fixed or {})
    for number, luck in LUCK.items() if not search.trials else ():
        trial = search.ask()
        trial.suggest_float("agent.lr", 1e-4, 1e-2)
        trial.set_user_attr(METRICS, {"mean_steps": luck, "success_rate": 0.5})
        search.tell(trial, [luck] * len(objectives))
        assert trial.number == number
    return storage, asked, search


def opened(uri, max_retries=10, **changes):
    """Open a final evaluation, whose trainings may lose their workers several times; return it, and its schedulers."""
    storage, asked, search = searched(uri, **changes)
    final = open_final_eval(storage, asked, search, None)
    limits = Limits(n_trials=10**9, max_retries=max_retries)
    phases = (
        (final.selection, final.missing_of_selection, final.unwanted_of_selection),
        (final.test, final.missing_of_test, final.unwanted_of_test),
    )
    return final, [
        TrialScheduler(study, storage, limits, plan, is_current=final.is_current, unwanted=unwanted)
        for study, plan, unwanted in phases
    ]


def steps_of(number, seed, true):
    """Return the steps of a training on each of three volumes; the same for the same training."""
    rng = np.random.default_rng((number + 1, seed))
    return true[number] + 0.3 * rng.standard_normal() + 0.2 * rng.standard_normal(3)


def end(scheduler, trial, true, measured=steps_of):
    """End a final training as its worker does."""
    number, seed = training_of(trial)
    steps = measured(number, seed, true)
    mean = np.nanmean(steps)
    metrics = {"mean_steps": mean, "test/mean_steps": mean, "test/success_rate": 1.0}
    metrics |= {f"test/volume/v{volume}/mean_steps": value for volume, value in enumerate(steps)}
    metrics |= {f"test/volume/v{volume}/success_rate": 1.0 for volume in range(3)}
    trial.set_user_attr(METRICS, {name: float(value) for name, value in metrics.items()})
    trial.study.tell(trial, float(mean))


def run(uri, true=TRUE, chance=None, measured=steps_of, **changes):
    """Run a final evaluation with workers that come and go; return it."""
    chance = chance or random.Random(0)
    final, schedulers = opened(uri, **changes)
    for scheduler in schedulers:
        running = []
        while True:
            while len(running) < 2 and (trial := scheduler.claim({"worker": str(len(running))})):
                running.append(trial)
            if not running:
                break
            trial = running.pop(chance.randrange(len(running)))
            if chance.random() < 0.2:
                # Its worker is killed.
                number = trial.number
                scheduler.reclaim(lambda each, number=number: each.number == number)
            elif chance.random() < 0.1:
                scheduler.requeue(trial, {"worker": trial.user_attrs["lease"]["worker"]})
            else:
                end(scheduler, trial, true, measured)
    return final


def trained(study):
    """Return the trainings that have finished."""
    return [training_of(trial) for trial in study.trials if trial.state == TrialState.COMPLETE]


def test_test_volumes_are_used_for_the_chosen_configuration_and_the_control_alone(
    storage_uri,
):
    final = run(storage_uri)
    assert final.contenders() == [CONTROL, 0, 1]
    assert final.race().chosen == 1
    assert {number for number, _ in trained(final.test)} == {CONTROL, 1}
    # The result uses no seed of the search or the selection.
    assert {seed for _, seed in trained(final.selection)} <= set(range(1000, 1005))
    assert {seed for _, seed in trained(final.test)} == {2000, 2001, 2002}
    result = study_result(final)
    assert (result.chosen, result.n_seeds, result.others) == (1, 3, ())
    difference = {each.metric: each for each in result.differences}["mean_steps"]
    assert difference.paired.low <= -3.0 <= difference.paired.high < 0
    assert difference.direction == "better"
    assert difference.probability.value == 1.0


@pytest.mark.parametrize("seed", range(6))
def test_workers_that_die_change_nothing_and_no_training_is_run_twice(tmp_path, seed):
    quiet, killed = run(str(tmp_path / "a"), chance=QUIET), run(str(tmp_path / "b"), chance=random.Random(seed))
    for name in ("selection", "test"):
        ours, theirs = (trained(getattr(final, name)) for final in (quiet, killed))
        assert len(theirs) == len(set(theirs))
        assert sorted(ours) == sorted(theirs)
    fewest, most = n_trainings(killed.settings, len(LUCK))
    assert len(trained(quiet.selection)) + len(trained(quiet.test)) in range(fewest, most + 1)


def test_control_is_tested_during_the_race_and_the_chosen_configuration_after_it(storage_uri):
    final, (selection, test) = opened(storage_uri)
    control = [(CONTROL, seed) for seed in final.test_seeds]
    running = selection.claim({})
    assert not final.race().is_over
    while trial := test.claim({}):
        end(test, trial, TRUE)
    assert trained(final.test) == control
    end(selection, running, TRUE)
    final = run(storage_uri, chance=QUIET)
    assert trained(final.test) == control + [(1, seed) for seed in final.test_seeds]
    assert study_result(final).chosen == 1


def test_study_whose_test_was_interrupted_says_how_many_trainings_are_missing(storage_uri):
    final, schedulers = opened(storage_uri)
    for scheduler, n_claims in zip(schedulers, (100, 5), strict=True):
        for _ in range(n_claims):
            if trial := scheduler.claim({}):
                end(scheduler, trial, TRUE)
    # Three seeds of the chosen configuration and of the control.
    assert final.n_untested == 1
    assert study_result(final).n_untested == 1
    run(storage_uri)
    assert final.n_untested == 0


def test_control_whose_trainings_failed_leaves_no_comparison_and_the_result_says_so(storage_uri):
    final, (selection, test) = opened(storage_uri)
    while trial := selection.claim({}):
        end(selection, trial, TRUE)
    while trial := test.claim({}):
        if trial.user_attrs[FINALIST] == CONTROL:
            test.study.tell(trial, state=TrialState.FAIL)
        else:
            end(test, trial, TRUE)
    expected = "Trial 1 was chosen, but it cannot be compared with the control: 0 of 3 seeds were trained"
    assert study_result(final).statement.startswith(expected)


def test_control_that_no_candidate_completed_the_race_beside_has_beaten_none(storage_uri):
    final, (selection, _) = opened(storage_uri)
    while trial := selection.claim({}):
        if trial.user_attrs[FINALIST] == CONTROL:
            end(selection, trial, TRUE)
        else:
            selection.study.tell(trial, state=TrialState.FAIL)
    expected = "The control was chosen, because trainings of all other candidates have failed."
    assert study_result(final).statement == expected


def test_control_that_was_tested_before_the_chosen_configuration_is_not_its_result(storage_uri):
    final, (selection, test) = opened(storage_uri)
    for scheduler in (test, selection):
        while trial := scheduler.claim({}):
            end(scheduler, trial, TRUE)
        # The chosen configuration is result later.
    result = study_result(final)
    assert (result.chosen, [each.number for each in result.results]) == (1, [CONTROL])
    assert result.of_chosen is None
    assert result_note(result) == ""
    assert not [name for name in best_metrics(final.search, result) if name.startswith("test_volumes/")]


def test_plan_counts_the_final_trainings_that_are_left(storage_uri):
    final, (selection, _) = opened(storage_uri)
    settings = searched(storage_uri)[1]
    fewest, most = final_trainings_left(settings, None, n_left=0)
    end(selection, selection.claim({}), TRUE)
    assert final_trainings_left(settings, final, n_left=0) == (fewest - 1, most - 1)
    final = run(storage_uri)
    assert final_trainings_left(settings, final, n_left=0) == (0, 0)
    # Further trials may change the candidates, or not.
    assert final_trainings_left(settings, final, n_left=1) == (0, most)
    more = settings.model_copy(
        update={"final_eval": settings.final_eval.model_copy(update={"test_seeds": len(final.test_seeds) + 2})}
    )
    assert final_trainings_left(more, final, n_left=0) == (4, 4)
    # A new candidate takes the place of one whose scores then do not count; the control has been tested.
    better = final.search.ask()
    better.suggest_float("agent.lr", 1e-4, 1e-2)
    final.search.tell(better, 0.5)
    n_missing = len(final.missing_of_selection())
    least, most = final_trainings_left(settings, final, n_left=0)
    assert 0 < n_missing <= least <= most
    assert f"at most {most} left" in final_line(settings, final, [9, 6])


def test_plan_has_no_more_candidates_than_trials(storage_uri):
    settings = searched(storage_uri)[1].final_eval.model_copy(update={"top_k": 100})
    assert n_trainings(settings, 2) == n_trainings(settings.model_copy(update={"top_k": 2}), 100)


def test_result_with_fewer_test_seeds_names_the_trainings_that_are_left_out(storage_uri):
    final = run(storage_uri)
    assert not [note for note in study_result(final).notes if "left out" in note]
    fewer = replace(final, settings=final.settings.model_copy(update={"test_seeds": 2}))
    (note,) = (note for note in study_result(fewer).notes if "left out" in note)
    assert note == "2 further trainings on the test volumes, left out: study.final_eval.test_seeds is 2"


def test_plan_knows_that_a_round_of_the_race_occupies_few_workers(storage_uri):
    settings = searched(storage_uri)[1].model_copy(update={"workers": 6})
    fewest, most = n_trainings(settings.final_eval, settings.n_trials)
    hours = hours_left(settings, None, n_left=12, trial_s=3600.0, training_s=1800.0)
    # Two trainings at a time, as a round has.
    assert hours == pytest.approx((2.0 + fewest * 0.5 / 6, 2.0 + most * 0.5 / 2))


def test_control_that_is_the_best_is_the_result(storage_uri):
    final = run(storage_uri, true=TRUE | {CONTROL: 1.0})
    result = study_result(final)
    assert result.chosen == CONTROL
    assert "No setting beat the control" in result.statement
    assert {number for number, _ in trained(final.test)} == {CONTROL}
    assert result.differences == ()


@pytest.mark.parametrize(("top_k", "contenders"), [(0, []), (1, [CONTROL, 1]), (2, [CONTROL, 1, 2])])
def test_trial_with_the_settings_of_the_control_is_no_candidate_beside_it(storage_uri, top_k, contenders):
    storage, asked, search = searched(storage_uri, top_k=top_k)
    # Neither a sampled trial nor one that was taken over is marked as having them.
    final = open_final_eval(storage, asked, search, search.trials[0].params)
    assert final.contenders() == contenders
    # As a report reads it.
    assert stored_final_eval(open_storage(storage_uri), search).contenders() == contenders


def test_training_that_failed_leaves_its_candidate_out_and_the_study_has_a_result(storage_uri):
    final, (selection, _) = opened(storage_uri)
    while trial := selection.claim({}):
        if trial.user_attrs[FINALIST] == 1:
            selection.study.tell(trial, state=TrialState.FAIL)
        else:
            end(selection, trial, TRUE)
    assert final.race().chosen == 0
    (failed,) = [each for each in candidates_of(final) if each.number == 1]
    assert failed.outcome == "failed"
    assert all(map(math.isnan, failed.scores.values()))


def test_interval_of_a_rate_ends_at_0_and_100_percent(monkeypatch, storage_uri):
    final = run(storage_uri, true={0: 0.6, 1: 0.9, 2: 0.7, CONTROL: 0.5})
    monkeypatch.setattr("armscan.sweeps.results.selection.objective_of", lambda _: "success_rate")
    intervals = [each.estimate for each in candidates_of(final) if math.isfinite(each.estimate.low)]
    assert intervals
    assert all(0.0 <= each.low <= each.high <= 1.0 for each in intervals)


def test_interval_of_steps_ends_at_the_longest_episode(storage_uri):
    final = run(storage_uri, true={0: 6.0, 1: 1.2, 2: 5.0, CONTROL: 9.9}, fixed={"env": {"max_steps": 10}})
    highs = [each.estimate.high for each in candidates_of(final) if math.isfinite(each.estimate.low)]
    assert max(highs) == 10
    assert candidates_of(final)[0].estimate.low >= 1.0


def test_study_that_goes_on_says_for_whom_else_the_test_volumes_were_used(storage_uri):
    run(storage_uri)
    _, _, search = searched(storage_uri)
    trial = search.ask()
    trial.suggest_float("agent.lr", 1e-4, 1e-2)
    search.tell(trial, 0.5)
    final = run(storage_uri, true=TRUE | {3: 0.5})
    assert (study_result(final).chosen, study_result(final).others) == (3, (1,))
    assert "used before for trial 1" in study_result(final).notes[0]


def test_run_of_a_study_that_goes_on_until_the_control_wins_keeps_no_difference(storage_uri):
    first = run(storage_uri)
    before = best_metrics(first.search, study_result(first))
    _, asked, search = searched(storage_uri)
    for number in range(asked.final_eval.top_k):
        trial = search.ask()
        trial.suggest_float("agent.lr", 1e-4, 1e-2)
        trial.set_user_attr(METRICS, {"mean_steps": 0.5, "success_rate": 0.5})
        search.tell(trial, 0.5 + 0.01 * number)
    worse = dict.fromkeys(range(3, 3 + asked.final_eval.top_k), 9.0)
    result = study_result(run(storage_uri, true=TRUE | worse))
    assert (result.chosen, result.others) == (CONTROL, (1,))
    after = best_metrics(search, result)
    invalid = [name for name in before if name.startswith((*COMPARISONS, "selection/"))]
    assert {"difference/mean_steps_low", "selection/mean_steps"} <= {*invalid}
    assert all(math.isnan(after[name]) for name in invalid)


def test_run_of_the_study_has_the_result(storage_uri):
    final = run(storage_uri)
    result = study_result(final)
    metrics = best_metrics(final.search, result)
    assert best_metrics(final.search, None) == {"selection/mean_steps": 1.0, "selection/success_rate": 0.5}
    assert metrics["selection/mean_steps"] == final.search.trials[result.chosen].user_attrs[METRICS]["mean_steps"] > 1
    assert metrics["difference/mean_steps_low"] < metrics["difference/mean_steps"] < 0
    assert metrics["probability_of_improvement/mean_steps"] == 1.0
    assert metrics["test_volumes/mean_steps"] < 4.0


def test_note_on_a_study_says_which_settings_how_sure_and_what_helps(storage_uri):
    final = run(storage_uri)
    said, chosen, control, *rest = result_note(study_result(final)).split("\n\n")
    assert said == "**Trial 1 is better than the control (steps, mean).**"
    assert chosen.startswith("trial 1: `agent.lr=0.0")
    assert control.startswith("control: the study's configuration without")
    assert "| with 95 % intervals | trial 1 | control |" in rest[1]
    assert rest[2] == "Trial 1 and the control, both with the same 3 new seeds:"
    difference = study_result(final).differences[0].row()
    assert rest[3].splitlines()[2] == f"| {' | '.join(difference.values())} |"
    assert rest[-1].startswith("Note: 3 test subjects, fewer than 8")


def test_one_test_seed_gives_a_difference_without_interval_and_the_result_says_so(storage_uri):
    final = run(storage_uri, test_seeds=1, episodes=3)
    said, *_, table, _, _ = result_note(study_result(final)).split("\n\n")
    assert said == "**Trial 1 was chosen; one seed does not show whether it is better than the control.**"
    first = table.splitlines()[2].split("|")
    assert float(first[2]) < 0.0
    assert first[3].strip() == first[5].strip() == ""


def test_note_on_a_study_that_has_no_result_is_empty(storage_uri):
    assert result_note(None) == result_note(study_result(opened(storage_uri)[0])) == ""


def test_final_evaluation_is_read_from_the_storage_and_that_of_an_earlier_version_is_none(storage_uri):
    storage, asked, search = searched(storage_uri)
    assert stored_final_eval(storage, search) is None
    optuna.create_study(study_name="a-judged", storage=storage.optuna)
    assert stored_final_eval(storage, search) is None
    final = open_final_eval(storage, asked, search, None)
    assert stored_final_eval(open_storage(storage_uri), search).settings == final.settings
    before = {"top_k": 2, "min_seeds": 3, "max_seeds": 8, "test_seeds": 5}
    final.selection.set_user_attr("final_eval", {"settings": before, "search_seed": 0, "control": None})
    assert stored_final_eval(storage, search) is None


def test_latest_trial_of_each_member_is_trained_with_its_whole_schedule(storage_uri):
    storage, asked, search = searched(storage_uri)
    schedule = [{"from_env_steps": 0, "agent.lr": 0.001}, {"from_env_steps": 400, "agent.lr": 0.002}]
    search.enqueue_trial({"agent.lr": 0.002}, user_attrs={MEMBER: 0, GENERATION: 1, SCHEDULE: schedule})
    member = search.ask()
    member.suggest_float("agent.lr", 1e-4, 1e-2)
    search.tell(member, 99.0)
    search.enqueue_trial({"agent.lr": 0.003}, user_attrs={MEMBER: 1, GENERATION: 0, SCHEDULE: schedule[:1]})
    behind = search.ask()
    behind.suggest_float("agent.lr", 1e-4, 1e-2)
    # Its next generation is not complete.
    search.tell(behind, 98.0)
    final = open_final_eval(storage, asked, search, None)
    # Better values of earlier generations are not of whole trainings.
    assert final.contenders() == [CONTROL, behind.number, member.number]
    planned = [each for each in final.missing_of_selection() if each.attributes[FINALIST] == member.number]
    assert len(planned) == FINAL_EVAL["min_seeds"]
    scheduler = TrialScheduler(final.selection, storage, Limits(n_trials=9), lambda: planned)
    trial = scheduler.claim({})
    assert searched_values(trial) == {"agent.lr": 0.001, "training.schedule": schedule[1:]}
    assert trial.suggest_float("agent.lr", 1e-4, 1e-2) == 0.001


@pytest.mark.parametrize("name", ["n_seeds", "judge_seeds"])
def test_stored_settings_of_an_earlier_version_are_read_and_those_of_a_sweep_refused(name):
    before = {"top_k": 2, "min_seeds": 2, "mean_seeds": 4, name: 7}
    assert FinalEvalSettings.read("a", before).model_dump() == FINAL_EVAL | {"test_seeds": 7, "episodes": None}
    # The default, or the command line, sets the new name.
    with pytest.raises(InvalidValueError, match=rf"study\.final_eval\.{name} is now study\.final_eval\.test_seeds"):
        FinalEvalSettings.read("a", before | {"test_seeds": 5})


def test_nothing_is_left_of_a_final_evaluation_whose_trainings_all_failed(storage_uri):
    final, (selection, _) = opened(storage_uri)
    while trial := selection.claim({}):
        selection.renew(trial, {"env_steps": 100})
        fail(selection, trial, "diverged")
    assert final.race().is_over
    assert final.race().chosen is None
    assert final_trainings_left(searched(storage_uri)[1], final, n_left=0) == (0, 0)
    assert final.missing_of_test() == []


def test_trainings_that_failed_before_a_restart_are_run_again(storage_uri):
    final, (selection, _) = opened(storage_uri)
    selection.limits = selection.limits.model_copy(update={"max_failures": 2})
    while trial := selection.claim({}):
        fail(selection, trial, "diverged")
    assert selection.reset_failures() >= 2
    run(storage_uri)
    assert final.race().chosen == 1


@pytest.mark.parametrize("phase", ["selection", "test"])
def test_final_evaluation_that_failed_is_run_again_once_it_is_started_again(storage_uri, phase):
    final, schedulers = opened(storage_uri)
    if phase == "test":
        while trial := schedulers[0].claim({}):
            end(schedulers[0], trial, TRUE)
    scheduler = dict(zip(("selection", "test"), schedulers, strict=True))[phase]
    assert final.blocked() == []
    while trial := scheduler.claim({}):
        # Too few failures to end the study.
        scheduler.renew(trial, {"env_steps": 100})
        fail(scheduler, trial, "the disk was full")
    assert final.blocked() == [scheduler.study.study_name]
    n_failed = len(scheduler.state().failed)
    assert scheduler.reset_failures() == 0
    assert scheduler.reset_failures(is_blocked=True) == n_failed
    assert scheduler.failures(scheduler.state()) == []
    run(storage_uri)
    assert study_result(final).n_seeds == FINAL_EVAL["test_seeds"]
    assert final.blocked() == []


@pytest.mark.parametrize("phase", [0, 1], ids=["selection", "test"])
def test_training_whose_worker_and_that_of_its_retry_died_is_run_again_after_a_restart(storage_uri, phase):
    final, schedulers = opened(storage_uri, max_retries=1)
    if phase == 1:
        while trial := schedulers[0].claim({"worker": "a"}):
            end(schedulers[0], trial, TRUE)
    scheduler = schedulers[phase]
    while trial := scheduler.claim({"worker": "a"}):
        scheduler.renew(trial, {"env_steps": 100})
        scheduler.reclaim(lambda _: True)
    assert final.blocked() == [scheduler.study.study_name]
    assert scheduler.reset_failures(is_blocked=True)
    final = run(storage_uri)
    assert (study_result(final).n_seeds, final.n_untested) == (FINAL_EVAL["test_seeds"], 0)


def test_trainings_that_wait_are_dropped_once_another_configuration_is_chosen(storage_uri):
    final, (selection, test) = opened(storage_uri)
    while trial := selection.claim({"worker": "a"}):
        end(selection, trial, TRUE)
    # All trainings of the test wait, and the study goes on.
    test.requeue(test.claim({"worker": "a"}), {"worker": "a"})
    trial = final.search.ask()
    trial.suggest_float("agent.lr", 1e-4, 1e-2)
    trial.set_user_attr(METRICS, {"mean_steps": 0.5, "success_rate": 0.5})
    final.search.tell(trial, 0.5)
    # Trial 1 is a candidate no more, and it has trainings that wait.
    selection.study.enqueue_trial({}, user_attrs={FINALIST: 1, FINAL_SEED: 1005})
    final = run(storage_uri, true=TRUE | {3: 0.5})
    assert (study_result(final).chosen, study_result(final).others) == (3, ())
    assert {number for number, _ in trained(final.test)} == {CONTROL, 3}
    assert (1, 1005) not in trained(final.selection)


def test_trainings_of_an_earlier_configuration_of_the_study_are_run_again(storage_uri):
    first = run(storage_uri)
    assert study_result(first).differences[0].paired.value < -2.5
    n_before = len(trained(first.test))
    again = run(storage_uri, true=dict.fromkeys(TRUE, 5.0) | {1: 4.9}, fixed={"env": {"max_steps": 40}})
    assert study_result(again).chosen == CONTROL or study_result(again).differences[0].paired.value > -1.0
    assert len(trained(again.test)) >= n_before + FINAL_EVAL["test_seeds"]
    assert "the test volumes were used before, with another configuration of the study" in study_result(again).notes


@pytest.mark.parametrize(("constraint", "is_kept"), [("mean_steps >= 2", False), ("mean_steps >= 0", True)])
def test_control_that_violates_a_constraint_is_tested_but_not_chosen(storage_uri, constraint, is_kept):
    final = run(storage_uri, true=TRUE | {CONTROL: 1.0}, constraints=[constraint])
    assert final.violated().get(CONTROL, []) == ([] if is_kept else [constraint])
    result = study_result(final)
    assert result.chosen == (CONTROL if is_kept else 1)
    told = f"the control violates {constraint} in the race, so it could not be chosen"
    assert (told in result.notes) is not is_kept
    assert {number for number, _ in trained(final.test)} == {CONTROL, result.chosen}


def test_control_that_violates_a_constraint_leaves_the_race_after_its_first_round(storage_uri):
    close = {CONTROL: 1.5, 0: 5.0, 1: 4.9, 2: 9.0}
    final = run(storage_uri, true=close, constraints=["mean_steps >= 3"], mean_seeds=5)
    seeds = {number: standing.n_seeds for number, standing in final.race().standings.items()}
    assert seeds[CONTROL] == FINAL_EVAL["min_seeds"]
    assert seeds[0] + seeds[1] == 10


def test_candidate_that_violates_a_constraint_in_the_race_is_not_chosen(storage_uri):
    final = run(storage_uri, true={CONTROL: 2.5, 0: 6.0, 1: 1.0, 2: 9.0}, constraints=["mean_steps >= 2"])
    assert final.violated() == {1: ["mean_steps >= 2"]}
    assert final.race().standings[1].is_withdrawn
    result = study_result(final)
    assert result.chosen == CONTROL
    assert "trial 1 violates mean_steps >= 2 in the race, so it could not be chosen" in result.notes


def test_configurations_race_on_if_all_violate_a_constraint(storage_uri):
    final = run(storage_uri, true={CONTROL: 5.0, 0: 6.0, 1: 4.0, 2: 9.0}, constraints=["mean_steps <= 1"])
    assert study_result(final).chosen == 1
    assert "trial 1 violates mean_steps <= 1 in the race" in study_result(final).notes


def test_one_seed_that_violates_a_constraint_does_not_decide(storage_uri):
    final, (selection, _) = opened(storage_uri, constraints=["mean_steps <= 3"])
    steps = iter((1.0, 4.0))
    while (trial := selection.claim({})) is not None:
        number, _ = training_of(trial)
        value = next(steps, 1.0) if number == CONTROL else 1.0
        trial.set_user_attr(METRICS, {"mean_steps": value})
        trial.study.tell(trial, value)
    assert final.violated() == {}


def test_configuration_that_violates_a_constraint_late_is_shown_over_all_its_seeds(storage_uri):
    final, (selection, _) = opened(storage_uri, constraints=["mean_steps <= 2.9"])
    steps = iter((1.0, 1.0, 1.0, 9.0, 9.0))
    n_trained = 0
    while (trial := selection.claim({})) is not None:
        is_control = training_of(trial)[0] == CONTROL
        value, n_trained = next(steps) if is_control else 2.0, n_trained + is_control
        trial.set_user_attr(METRICS, {"mean_steps": value})
        trial.study.tell(trial, value)
    standing = final.race().standings[CONTROL]
    assert standing.is_withdrawn
    assert standing.n_seeds == n_trained == 4
    assert standing.estimate.value == pytest.approx(-3.0)


def test_configuration_that_is_changed_back_trains_what_the_other_dropped(storage_uri):
    other = {"env": {"max_steps": 40}}
    for fixed in (None, other):
        _, (selection, _) = opened(storage_uri, fixed=fixed)
        selection.requeue(selection.claim({"worker": "a"}), {"worker": "a"})
    final = run(storage_uri)
    assert final.race().chosen == 1
    dropped = [trial for trial in final.selection.trials if trial.state == TrialState.FAIL]
    told = {row["cause"] for row in _ending_rows(dropped)}
    assert NOT_NEEDED in told
    assert f"{NOT_NEEDED}, retried" not in told


def test_difference_counts_volumes_of_one_arm_once(storage_uri, monkeypatch):
    given = []
    monkeypatch.setattr(difference_module, "subjects_of", lambda _: {"v0": "a", "v1": "a", "v2": "b"})

    def recorded(*arguments):
        given.append(arguments[2])
        return paired_difference(*arguments)

    monkeypatch.setattr(difference_module, "paired_difference", recorded)
    study_result(run(storage_uri))
    assert given[0] == ["a", "a", "b"]


def test_training_that_waits_for_its_retry_is_still_to_be_tested(storage_uri):
    final = run(storage_uri, test_seeds=3)
    _, (_, test) = opened(storage_uri, test_seeds=4)
    final, _ = opened(storage_uri, test_seeds=4)
    n_untested = final.n_untested
    assert n_untested > 0
    test.claim({"worker": "a"})
    test.reclaim(lambda _: True)
    assert final.n_untested == n_untested


def test_settings_that_a_continued_study_has_are_stored(storage_uri):
    opened(storage_uri)
    opened(storage_uri, test_seeds=5)
    storage, _, search = searched(storage_uri)
    assert len(stored_final_eval(storage, search).test_seeds) == 5


def test_trainings_of_an_earlier_configuration_neither_run_nor_count_as_failed(storage_uri):
    _, (_, test) = opened(storage_uri)
    fail(test, test.claim({"worker": "a"}), "the disk was full")
    test.requeue(trial := test.claim({"worker": "a"}), {"worker": "a"})
    assert test.claim({"worker": "b"}).number == trial.number
    test.requeue(trial, {"worker": "b"})
    final, (_, again) = opened(storage_uri, fixed={"env": {"max_steps": 40}})
    assert again.failures(again.state()) == []
    assert again.claim({"worker": "c"}).number > trial.number
    # The command that has the earlier configuration trains no more.
    assert test.claim({"worker": "a"}) is None
    assert final.test.trials[trial.number].state == TrialState.FAIL


def test_training_of_the_final_evaluation_cannot_be_stopped_alone(storage_uri):
    final, (selection, _) = opened(storage_uri)
    running = selection.claim({"worker": "a"})
    with pytest.raises(StudyError, match="cannot be stopped alone"):
        stop_trial(storage_uri, final.selection.study_name, running.number)


def test_difference_that_is_the_same_everywhere_has_no_interval_to_speak_of():
    same = Estimate(1.0, 1.0, 1.0)
    difference = Difference("success_rate", True, same, Estimate(1.0, 1.0, 1.0))
    result = StudyResult(
        chosen=3, results=(), differences=(difference,), n_seeds=2, n_planned=2, others=(), settings={}
    )
    assert (
        result.statement
        == "Trial 3 was chosen; its difference from the control is +100.0 points for every seed and volume "
        "(success, by reward)."
    )


def test_difference_that_is_not_0_does_not_look_like_it():
    difference = Difference("median_distance_mm", False, Estimate(-0.03, -0.049, -0.011), Estimate(1.0, 0.501, 1.0))
    row = difference.row()
    assert row["chosen minus control"] == "-0.03"
    assert row["95 % interval"] == "-0.049 to -0.011"
    assert row["its 95 % interval"] == "50.1% to 100.0%"


@pytest.mark.parametrize("n_unknown", [1, 3])
def test_volume_without_a_value_is_left_out_of_the_comparison_and_the_result_says_so(storage_uri, n_unknown):
    def steps_with_unknown(number, seed, true):
        steps = steps_of(number, seed, true)
        # One volume of a tested training, or another one of each.
        unknown = {1: [(1, 2001, 1)], 3: [(1, 2000, 0), (1, 2001, 1), (CONTROL, 2002, 2)]}[n_unknown]
        return np.where([(number, seed, volume) in unknown for volume in range(3)], np.nan, steps)

    final = run(storage_uri, chance=QUIET, measured=steps_with_unknown)
    result = study_result(final)
    first = result.differences[0]
    assert (first.metric, first.n_left_out) == ("mean_steps", n_unknown)
    assert f"steps, mean is compared without {n_unknown} test volume" in " ".join(result.notes)
    if n_unknown == 1:
        assert result.statement == "Trial 1 is better than the control (steps, mean)."
    else:
        assert result.statement == (
            "Trial 1 was chosen, but it cannot be compared with the control (steps, mean): no test volume has a value "
            "in every training."
        )
        assert set(first.row().values()) == {"steps, mean (lower is better)", ""}
    assert result_note(result)
