"""Summaries of a configuration by its final trainings."""

import json
from dataclasses import replace

import numpy as np
import pytest
from optuna.trial import TrialState, create_trial
from scipy.stats import ttest_1samp

from armscan.errors import StudyError
from armscan.sweeps.results.final_results import final_results, final_table, scores_of
from armscan.sweeps.storage.attribute_names import EPISODES, FINAL_SEED, FINALIST, METRICS, SUBJECTS
from armscan.training import Evaluation
from tests.training.test_result_table import made_episodes, recomputed


def training(number, metrics, state=TrialState.COMPLETE):
    value = 0.0 if state == TrialState.COMPLETE else None
    return create_trial(state=state, value=value, user_attrs={FINALIST: number, METRICS: metrics})


def figures_of(of_volumes):
    metrics = {"mean_steps": 1.0, "test/mean_steps": float(np.mean(of_volumes)), "test/success_rate": 0.7}
    return metrics | {f"test/volume/v{i}/mean_steps": value for i, value in enumerate(of_volumes)}


def test_result_is_over_seeds_and_test_volumes():
    scores = np.random.default_rng(0).gamma(2.0, 2.0, (5, 8))
    (result,) = final_results([training(7, figures_of(list(of_seed))) for of_seed in scores])
    assert (result.number, result.figures.n_seeds, result.figures.n_volumes) == (7, 5, 8)
    assert result.figures.estimates.keys() == {"mean_steps", "success_rate"}
    mean, low, high = result.figures.estimates["mean_steps"]
    assert mean == pytest.approx(scores.mean())
    assert low < mean < high
    assert result.figures.estimates["success_rate"].value == pytest.approx(0.7)
    # All scores are equal.
    assert np.isnan(result.figures.estimates["success_rate"][1:]).all()


def test_volumes_of_one_subject_count_as_one_also_without_episodes():
    scores, subjects = np.array([[1.0, 1.2, 3.0, 3.4]] * 2), {"v0": "a", "v1": "a", "v2": "b", "v3": "b"}
    trials = [training(0, figures_of(list(of_seed))) for of_seed in scores]
    (alone,) = final_results(trials)
    for trial in trials:
        trial.system_attrs = {SUBJECTS: subjects}
    (result,) = final_results(trials)
    assert (alone.figures.n_subjects, result.figures.n_subjects, result.figures.n_volumes) == (4, 2, 4)
    expected = ttest_1samp([1.1, 3.2], 0.0).confidence_interval()
    assert result.figures.estimates["mean_steps"] == pytest.approx((2.15, *expected))
    trials[0].system_attrs = {SUBJECTS: {"v0": 3}}
    with pytest.raises(StudyError, match="the subjects of a final training in the storage are damaged"):
        final_results(trials)


def test_result_of_the_same_trials_is_the_same_and_lacks_those_that_have_not_finished():
    scores = np.random.default_rng(0).gamma(2.0, 2.0, (2, 6, 8))
    trials = [training(number, figures_of(list(scores[number - 1, seed]))) for number in (1, 2) for seed in range(6)]
    trials.append(training(2, figures_of([0.0]), TrialState.FAIL))
    first, second = final_results(trials), final_results(trials)
    assert first == second
    assert [result.figures.n_seeds for result in first] == [6, 6]


def test_result_of_one_seed_has_no_interval():
    (result,) = final_results([training(0, figures_of([2.0]))])
    mean, low, high = result.figures.estimates["mean_steps"]
    assert mean == 2.0
    assert np.isnan([low, high]).all()


def test_result_leaves_out_figures_that_some_seeds_lack():
    uneven = [training(0, figures_of([2.0]) | {f"test/only_{seed}": 1.0}) for seed in range(2)]
    (result,) = final_results(uneven)
    assert result.figures.estimates.keys() == {"mean_steps", "success_rate"}


def test_result_leaves_the_draws_of_others_alone():
    before = np.random.get_bit_generator().state
    (result,) = final_results([training(0, figures_of([float(seed), 3.0])) for seed in range(3)])
    assert result.figures.n_seeds == 3
    np.testing.assert_equal(np.random.get_bit_generator().state, before)


def test_result_on_one_volume_has_the_interval_of_student():
    scores = np.random.default_rng(0).gamma(2.0, 2.0, (20, 1))
    (result,) = final_results([training(7, figures_of(list(of_seed))) for of_seed in scores])
    expected = ttest_1samp(scores[:, 0], 0.0).confidence_interval()
    assert result.figures.estimates["mean_steps"][1:] == pytest.approx(expected)


def test_table_of_a_study_is_that_of_the_episodes_that_it_keeps():
    of_seeds = {seed: made_episodes(seed) for seed in (1000, 1001, 1002)}
    kept = {
        seed: {
            "test volumes": {"on_plane": [[5, 10], [2, 5]], "episodes": Evaluation(episodes).columns()},
            "random": {"on_plane": [[5, 10], [2, 5]], "episodes": Evaluation(made_episodes(7)).columns()},
        }
        for seed, episodes in of_seeds.items()
    }
    trials = [
        create_trial(
            value=0.0,
            user_attrs={FINALIST: 4, FINAL_SEED: seed, METRICS: {"test/mean_steps": 0.0}},
            # As a storage gives it back.
            system_attrs={EPISODES: json.loads(json.dumps(each))},
        )
        for seed, each in kept.items()
    ]
    table = final_table(final_results(trials))
    assert list(table.results) == ["trial 4", "random"]
    episodes = [episode for each in of_seeds.values() for episode in each]
    for name, expected in recomputed(episodes).items():
        assert table.results["trial 4"].estimates[name].value == pytest.approx(expected), name
    counts = table.results["trial 4"]
    assert (counts.n_seeds, counts.n_volumes, counts.n_episodes) == (3, 4, 3 * len(of_seeds[1000]))
    assert final_results(trials) == final_results(trials)


def test_baselines_of_other_rules_are_named_after_their_trials():
    def trial(number, baseline):
        episodes = {"test volumes": made_episodes(0), "random": baseline}
        kept = {
            name: {"on_plane": [[5, 10]], "episodes": Evaluation(each).columns()} for name, each in episodes.items()
        }
        attributes = {FINALIST: number, FINAL_SEED: 1, METRICS: {}}
        return create_trial(value=0.0, user_attrs=attributes, system_attrs={EPISODES: kept})

    ours = made_episodes(7)
    others = tuple(replace(episode, n_steps=50) for episode in ours)
    table = final_table(final_results([trial(0, ours), trial(1, ours), trial(2, others)]))
    assert list(table.results) == ["trial 0", "trial 1", "trial 2", "random of trial 0, trial 1", "random of trial 2"]


@pytest.mark.parametrize("kept", [3, {"test volumes": 3}, {"test volumes": {"episodes": {}, "on_plane": []}}], ids=str)
def test_episodes_that_a_stranger_has_written_are_one_line(kept):
    trial = create_trial(value=0.0, user_attrs={FINALIST: 0, FINAL_SEED: 1, METRICS: {}}, system_attrs={EPISODES: kept})
    with pytest.raises(StudyError, match="final training -1: its episodes in the storage"):
        final_results([trial])


def test_scores_are_of_the_volumes_that_all_trainings_have():
    metrics = {"test/mean_steps": 2.0, **{f"test/volume/{name}/mean_steps": 1.0 for name in "abc"}}
    added = {key: value for key, value in metrics.items() if key != "test/volume/b/mean_steps"}
    volumes, scores = scores_of("test/mean_steps", [metrics, added])
    assert (volumes, scores.shape) == (["a", "c"], (2, 2))
    volumes, scores = scores_of("test/mean_steps", [metrics, {"test/volume/d/mean_steps": 1.0}])
    assert (volumes, scores.size) == ([], 0)


@pytest.mark.parametrize("metric", ["mean_steps", "on_plane_5mm_10deg", "on_plane_2.5mm_5deg"])
def test_scores_are_of_each_volume_whatever_the_name_of_the_metric(metric):
    of_volumes = [f"test/volume/a/b/{metric}", f"test/volume/c/{metric}"]
    seeds = [dict(zip((f"test/{metric}", *of_volumes), (0.5, seed, 1.0), strict=True)) for seed in (2.0, 3.0)]
    volumes, scores = scores_of(f"test/{metric}", seeds)
    assert volumes == ["a/b", "c"]
    assert scores.tolist() == [[2.0, 1.0], [3.0, 1.0]]
