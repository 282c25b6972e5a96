"""Comparisons of made-up groups: numbers, settings and volumes."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.reports.charts import final_chart
from armscan.reports.comparison import _cell, write_comparison
from armscan.reports.groups import Group, group_trainings
from armscan.reports.significance import baseline_metrics, compare_groups, complement, final_metrics, have_same_volumes
from armscan.stats.aggregation import probability_of_improvement
from armscan.stats.bootstrap import Estimate
from armscan.training import Evaluation
from tests.reports.conftest import make_episode, rows


@pytest.fixture
def written(tmp_path):
    """Write the report of trainings; return the page, and a file's rows by its name."""

    def write(*trainings):
        file = write_comparison(*group_trainings(trainings), "runs", tmp_path)
        return file.read_text(), lambda name: rows(tmp_path / f"{name}.csv")

    return write


def test_group_whose_best_weights_are_from_the_pretraining_has_a_note(written, make_training):
    params = {"agent.pretraining_env_steps": "100"}
    page, _ = written(*(make_training(seed, params=params, best_env_steps=float(100 + seed)) for seed in range(3)))
    assert "the best weights of 1 of 3 runs are from the pretraining" in page
    assert "from the pretraining" not in written(make_training(best_env_steps=100.0))[0]


def test_twenty_groups_have_a_report(written, make_training):
    page, rows = written(
        *(make_training(seed, params={"agent.lr": str(lr)}, mean_steps=lr) for lr in range(1, 21) for seed in range(2))
    )
    assert "40 runs in 20 groups" in page
    assert len(rows("improvement")) == 4 * 20 * 19 / 2
    assert page.count("data-video") == 20
    steps = {row["group"]: float(row["value"]) for row in rows("final") if row["metric"] == "mean_steps"}
    assert steps == {f"agent.lr={lr}": lr for lr in range(1, 21)}


def test_curves_of_very_many_groups_are_means_alone_and_the_page_says_so(written, make_training):
    page, rows = written(
        *(make_training(seed, params={"agent.lr": str(lr)}) for lr in range(1, 26) for seed in range(2))
    )
    assert "only the means are drawn" in page
    assert len(rows("seed_curves")) == 25 * 2 * 2 * 2
    assert {row["low"] for row in rows("curves")} != {""}


def test_fewer_steps_are_better_and_equal_ones_are_no_difference(make_training):
    trainings = [
        make_training(seed, params={"agent.lr": str(lr)}, mean_steps=steps)
        for lr, steps in ((1, 2), (2, 5), (3, 2))
        for seed in range(3)
    ]
    compared = compare_groups(group_trainings(trainings)[0])["mean_steps"]
    pairs = {(pair.ours, pair.theirs): pair.probability for pair in compared}
    assert {names: probability.value for names, probability in pairs.items()} == {(0, 1): 1.0, (0, 2): 0.5, (1, 2): 0.0}
    assert 0.5 < pairs[0, 1].low < pairs[0, 1].high == 1.0
    assert pairs[0, 2].low < 0.5 < pairs[0, 2].high


@pytest.mark.parametrize("metric", ["on_plane_rate", "median_distance_mm"])
def test_planes_nearer_to_the_labelled_one_are_better(make_training, metric):
    trainings = [
        make_training(seed, params={"agent.lr": str(lr)}, mean_steps=steps)
        for lr, steps in ((1, 2), (2, 9))
        for seed in range(2)
    ]
    (pair,) = compare_groups(group_trainings(trainings)[0])[metric]
    assert pair.probability.value == 1.0


def test_probability_of_the_other_side_has_its_ends_in_order():
    assert complement(Estimate(0.75, 0.5, 1.0)) == (0.25, 0.0, 0.5)


def test_group_whose_seeds_were_tested_on_different_volumes_is_not_compared(make_training):
    usual = [make_training(seed, params={"agent.lr": "1"}) for seed in range(2)]
    mixed = [
        make_training(seed, params={"agent.lr": "2"}, evaluation=Evaluation((make_episode(f"v{seed}", 1),)))
        for seed in range(2)
    ]
    (pair,) = compare_groups(group_trainings([*usual, *mixed])[0])["mean_steps"]
    assert pair.probability is None


@pytest.mark.parametrize(
    ("volumes", "is_compared"),
    [({"test": {"v0": "a", "v1": "b"}}, True), ({"test": {"v0": "a", "v1": "c"}}, False), (None, True)],
    ids=["same", "other", "unknown"],
)
def test_groups_judged_on_other_volumes_are_not_compared(written, make_training, volumes, is_compared):
    ours = [make_training(seed, params={"agent.lr": "1"}) for seed in range(2)]
    page, rows = written(*ours, *(make_training(seed, params={"agent.lr": "2"}, volumes=volumes) for seed in range(2)))
    assert len(rows("improvement")) == (4 if is_compared else 0)
    assert ("Not all groups were judged on the same test volumes" in page) == (not is_compared)
    assert ("<small>other volumes</small>" in page) == (not is_compared)


def test_final_figures_are_of_all_seeds_volumes_and_episodes(make_training):
    (group,), _ = group_trainings([make_training(seed, mean_steps=steps) for seed, steps in enumerate((2, 4, 9))])
    metrics = final_metrics(group)
    assert (metrics.n_volumes, metrics.n_episodes) == (2, 12)
    assert metrics.estimates["mean_steps"] == (5.0, 2.0, 9.0)


def test_success_without_a_failure_has_the_interval_of_wilson(written, make_training):
    page, _ = written(make_training(0), make_training(1))
    assert "100.0%<br> <small>67.6–100.0</small>" in page


def test_the_video_is_of_the_median_training(written, make_training):
    trainings = [make_training(seed, mean_steps=steps) for seed, steps in enumerate((9, 5, 2))]
    page, _ = written(*trainings, make_training(3, evaluation=None), make_training(4, video=None, mean_steps=1))
    assert "<figcaption>1. sac: seed 1</figcaption>" in page


def test_what_is_shown_is_no_markup(written, make_training):
    page, _ = written(*(make_training(params={"data.path": f"<b>{name}</b>"}) for name in "ab"))
    assert "<b>a</b>" not in page
    assert "1. data.path=&lt;b&gt;a&lt;/b&gt;" in page


def test_runs_that_were_left_out_and_rules_that_differ_are_said(written, make_training):
    page, _ = written(
        make_training(0, params={"env.success_threshold": "0.05"}, run_id="a" * 32),
        make_training(0, params={"env.success_threshold": "0.05"}, run_id="b" * 32, started_ms=9),
        make_training(0, params={"env.success_threshold": "0.01"}),
    )
    assert "another run has the same configuration and seed: aaaaaaaa (seed 0)." in page
    assert "have different rules (env.success_threshold)" in page


def test_groups_have_the_ids_of_their_runs_and_rounded_times(written, make_training):
    series = make_training().series
    long = {name: replace(each, wall_s=each.wall_s + 1 / 3) for name, each in series.items()}
    page, _ = written(make_training(0, series=long, run_id="abcdef01" * 4), make_training(1, run_id="12345678" * 4))
    summary = page.partition("<h2>")[0]
    assert "abcdef01 (0), 12345678 (1)" in summary
    assert '<td class=word data-label="training, s"><div>4 (4–4)</div></td>' in summary
    assert '<td class=word data-label="environment steps"><div>200</div></td>' in summary


def test_curves_have_markers_and_videos_come_after_charts(written, make_training):
    page, _ = written(*(make_training(0, params={"agent.lr": str(lr)}) for lr in (1, 2)))
    assert page.count('"mode":"lines+markers"') == 2 * 2
    assert page.rindex("<h2>Which") < page.index("<h2>Episodes") < page.index("<h2>Runs")


def test_long_tables_are_folded_and_name_their_cells_for_a_phone(written, make_training):
    page, _ = written(*(make_training(seed) for seed in range(30)))
    assert "<summary>All 30 runs</summary>" in page
    assert '<td data-label="1. ' in page
    assert '<td class=word data-label="status"><div>finished</div></td>' in page


def test_many_groups_are_compared_below_a_line_that_opens_them(written, make_training):
    page, _ = written(*(make_training(0, params={"agent.lr": str(lr)}) for lr in range(13)))
    assert "<summary>Each of 13 groups against each other</summary>" in page


def test_folds_of_a_grid_are_one_configuration_with_intervals_by_wrist(written, make_training):
    def fold(seed, number, mean_steps):
        volume = f"w{number}"
        return make_training(
            seed,
            params={"data.folds": "leave_one_out", "data.fold": str(number)},
            run_id=f"{10 * seed + number:032x}",
            evaluation=Evaluation(tuple(make_episode(volume, mean_steps) for _ in range(4))),
            volumes={"training": {f"w{other}": "" for other in range(3) if other != number}, "test": {volume: ""}},
        )

    trainings = [fold(seed, number, steps) for seed in range(2) for number, steps in enumerate((2, 4, 9))]
    groups, left_out = group_trainings(trainings)
    assert (len(groups), left_out) == (1, [])
    assert (groups[0].n_seeds, groups[0].n_folds) == (2, 3)
    metrics = final_metrics(groups[0])
    assert (metrics.n_seeds, metrics.n_volumes, metrics.n_episodes) == (2, 3, 24)
    # Both seeds are alike: the interval is of wrists.
    assert metrics.estimates["mean_steps"] == (5.0, 2.0, 9.0)
    page, _ = written(*trainings)
    assert "is a cross-validation: the figures on the test volumes are over 3 folds, each" in page
    assert "differ by nothing but the seed and the fold" in page
    assert "not tested on" not in page
    page, _ = written(*trainings[:-1])
    assert "the figures on the test volumes are over 2 folds" in page
    assert "not all seeds were tested on fold 2, which is left out of the figures on the test volumes" in page
    assert "Group 1: 1 of its 3 volumes were not tested on, so the figures are without w2." in page
    (group,), _ = group_trainings(trainings[:-1])
    assert final_metrics(group).estimates["mean_steps"].value == 3.0


def test_report_of_runs_that_were_not_evaluated_is_made(written, make_training):
    page, _ = written(make_training(evaluation=None))
    assert "None of these runs has kept a final evaluation." in page


def test_headline_names_no_best_of_groups_with_other_volumes_or_rules(written, make_training):
    rates = {"a": make_training(0, params={"agent.lr": "0.1"}), "b": make_training(0, params={"agent.lr": "0.2"})}
    page, _ = written(*rates.values())
    assert "best of 2, chosen on these volumes" in page
    page, _ = written(rates["a"], make_training(0, params={"env.max_steps": "9"}))
    assert "<strong>No best group: the groups were judged in different tasks" in page
    assert "chosen on these volumes" not in page
    other = {"test": {"v1": "another"}}
    page, _ = written(rates["a"], make_training(0, params={"agent.lr": "0.2"}, volumes=other))
    assert "chosen on these volumes" not in page


@pytest.mark.parametrize("part", ["training", "test"])
def test_runs_of_a_group_that_had_other_volumes_are_told(written, make_training, part):
    usual = make_training(0)
    other = make_training(1, volumes=usual.volumes | {part: usual.volumes[part] | {"v1": "changed"}})
    page, _ = written(usual, other)
    assert "the runs did not have the same volumes" in page
    assert "differ by nothing but the seed, except for their volumes" in page
    page, _ = written(usual, make_training(1), make_training(2, volumes=None))
    assert "the same volumes" not in page
    assert "differ by nothing but the seed." in page


def test_curve_of_some_seeds_alone_is_told(written, make_training):
    without = make_training(2)
    del without.series["validation/mean_steps"]
    page, _ = written(make_training(0), make_training(1), without)
    assert "Group 1: the curve of steps, mean is over 2 of its 3 seeds" in page
    page, _ = written(make_training(0), make_training(1))
    assert "the curve of steps" not in page


@pytest.mark.parametrize(
    ("key", "values", "versions", "differs"),
    [
        ("commit", ("0123456789", "abcdef0123"), "versions of armscan: 01234567, abcdef01.", "armscan's version"),
        ("own_code", ("parts:01", "parts:02"), "versions of parts (tag own_code).", "the code of own classes"),
    ],
    ids=["armscan", "own classes"],
)
def test_runs_of_a_group_that_ran_other_code_are_told(written, make_training, key, values, versions, differs):
    page, _ = written(*(make_training(seed, **{key: value}) for seed, value in enumerate(values)))
    assert f"Group 1: its runs used different {versions}" in page
    assert f"differ by nothing but the seed, except for {differs}." in page
    page, _ = written(make_training(0, **{key: values[0]}), make_training(1, **{key: None}))
    assert "used different versions" not in page


def test_groups_that_ran_other_code_are_told(written, make_training):
    page, _ = written(
        make_training(0, commit="0123456789"), make_training(0, commit="abcdef0123", params={"agent.lr": "1"})
    )
    assert "The groups used different versions of armscan: group 1 01234567, group 2 abcdef01." in page


def test_pairs_that_chance_alone_sets_in_bold_are_counted(written, make_training):
    # Four groups of three seeds and one of two, which none of the others can be told apart from.
    page, _ = written(
        *(make_training(seed, params={"agent.lr": str(lr)}) for lr in range(5) for seed in range(3 if lr else 2))
    )
    assert "If all groups were alike, at most 0.3 of 6 pairs would be bold by chance, on average." in page


def test_end_that_excludes_one_half_is_not_rounded_to_it():
    cell = _cell(probability_of_improvement(np.ones((3, 1)), np.zeros((3, 1))), is_few=True)
    assert "<b>1.00</b>" in cell
    assert "0.501 to 1.000" in cell


def test_numbers_of_the_baselines_are_in_a_file(written, make_training):
    _, rows = written(make_training(0, baselines={"random": Evaluation((make_episode("a", 7),))}))
    of_random = [row for row in rows("final") if row["group"] == "random"]
    assert [row["value"] for row in of_random if row["metric"] == "mean_steps"] == ["7.0"]


def test_figures_of_one_evaluation_are_of_all_its_episodes(make_training):
    episodes = [make_episode("a", 2), make_episode("b", 2), make_episode("b", 8)]
    (group,), _ = group_trainings([make_training(evaluation=Evaluation(tuple(episodes)))])
    metrics = final_metrics(group)
    assert (metrics.n_episodes, metrics.estimates["mean_steps"].value) == (3, 4.0)


def test_one_tested_seed_is_told_also_among_seeds_that_were_only_searched_with(written, make_training):
    page, _ = written(make_training(0), *(make_training(seed, evaluation=None) for seed in range(1, 6)))
    assert "one seed says nothing about other seeds" in page


def test_group_whose_seeds_were_tested_on_other_volumes_is_not_set_beside_random_planes(make_training):
    random = {"random": Evaluation((make_episode("v0", 9),))}
    one, other = (
        make_training(seed, evaluation=Evaluation((make_episode(volume, 1),)), baselines=random)
        for seed, volume in enumerate(("v0", "v1"))
    )
    (mixed,), _ = group_trainings([one, other])
    (alone,), _ = group_trainings([one])
    assert [have_same_volumes([group]) for group in (alone, mixed)] == [True, False]
    assert [len(each) for each in baseline_metrics([alone, mixed])] == [1, 0]


def test_dots_of_a_cross_validation_are_its_seeds(make_training):
    folds = [{"data.folds": "2", "data.fold": fold} for fold in ("0", "1")]
    trainings = tuple(make_training(seed, params=fold, mean_steps=1 + seed) for seed in (0, 1) for fold in folds)
    group = Group(1, "all", "1", trainings)
    dots, *_ = final_chart([group], [final_metrics(group)], {}).data
    assert list(dots.text) == ["seed 0", "seed 1"]
