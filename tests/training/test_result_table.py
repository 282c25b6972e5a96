"""The table of results: its figures recomputed by the test, its names, and how it fits its output."""

import html.parser
import io
import math
import re

import numpy as np
import pytest
from rich.console import Console

from armscan.errors import InvalidValueError
from armscan.training import Evaluation, MetricEstimates, OnPlane, ResultTable, check_on_plane
from armscan.training.result_table import with_baselines
from tests.training.test_train import episode_of, evaluation_of

PLANE, STRICT = "on_plane_5mm_10deg", "on_plane_2mm_5deg"


def made_episodes(seed, n=24, n_volumes=4):
    rng = np.random.default_rng(seed)
    return tuple(
        episode_of(
            volume=f"v{i % n_volumes}",
            seed=i,
            n_steps=int(rng.integers(1, 50)),
            is_success=bool(rng.random() < 0.7),
            distance_mm=float(rng.gamma(2.0, 2.0)),
            distance_deg=float(rng.gamma(2.0, 4.0)),
            dice_artery=float(rng.random()),
        )
        for i in range(n)
    )


def test_rates_are_shown_if_the_first_result_has_none():
    figures = MetricEstimates.of(Evaluation(made_episodes(0)))
    table = ResultTable({"0": MetricEstimates.of_metrics({}), "1": figures})
    assert [column.metric for column in table.quantities][:2] == [PLANE, STRICT]


def recomputed(episodes):
    """Return the figures of episodes by numpy alone."""

    def column(name):
        return np.array([getattr(episode, name) for episode in episodes], float)

    mm, deg, steps = column("distance_mm"), column("distance_deg"), np.sort(column("n_steps"))
    quarter = len(steps) // 4
    return {
        PLANE: np.mean((mm <= 5) & (deg <= 10)),
        STRICT: np.mean((mm <= 2) & (deg <= 5)),
        "median_distance_mm": np.median(mm),
        "p90_distance_mm": np.percentile(mm, 90),
        "median_distance_deg": np.median(deg),
        "p90_distance_deg": np.percentile(deg, 90),
        "success_rate": column("is_success").mean(),
        "mean_steps": steps.mean(),
        "iqm_steps": steps[quarter : len(steps) - quarter].mean(),
        "mean_dice_artery": column("dice_artery").mean(),
    }


def text_of(parts, width):
    console = Console(width=width, record=True, file=io.StringIO())
    for part in parts:
        console.print(part)
    return console.export_text()


def test_figures_are_those_of_all_episodes_and_intervals_hold_them():
    episodes = made_episodes(0)
    figures = MetricEstimates.of(Evaluation(episodes))
    for name, expected in recomputed(episodes).items():
        value, low, high = figures.estimates[name]
        assert value == pytest.approx(expected), name
        assert low <= value <= high
    assert figures == MetricEstimates.of(Evaluation(episodes))


def test_on_plane_limits_are_those_that_are_asked_for_and_name_their_rates():
    limits = check_on_plane("evaluation.on_plane", [[3, 7.5]])
    evaluation = Evaluation(made_episodes(1), limits)
    expected = np.mean([each.distance_mm <= 3 and each.distance_deg <= 7.5 for each in evaluation.episodes])
    assert evaluation.metrics()["on_plane_3mm_7.5deg"] == evaluation.on_plane_rate == pytest.approx(expected)
    assert Evaluation.of_dict(evaluation.to_dict()) == evaluation
    table = ResultTable({"agent": MetricEstimates.of(evaluation)})
    assert [column.title for column in table.quantities][:2] == ["on plane, 3 mm 7.5°", "distance mm, median"]


@pytest.mark.parametrize(
    "limits", [[], None, "5", [[5]], [[5, 0]], [[-1, 5]], [5, 10], [[5, 10], [5.0, 10.0]], [["a", 1]]]
)
def test_limits_that_are_none_are_refused(limits):
    with pytest.raises(
        InvalidValueError, match=rf"^evaluation\.on_plane is {re.escape(repr(limits))}, but it must be a list"
    ):
        check_on_plane("evaluation.on_plane", limits)


def test_rate_without_a_failure_has_the_interval_of_wilson():
    figures = MetricEstimates.of(evaluation_of(2, 4))
    assert figures.estimate("success_rate") == figures.estimates["success_rate_wilson"]
    assert figures.estimate("success_rate").low == pytest.approx(0.342, abs=1e-3)
    assert all(math.isnan(end) for end in figures.estimate("nothing"))


def test_figures_that_were_tracked_are_read_again():
    figures = MetricEstimates.of(Evaluation(made_episodes(2)))
    again = MetricEstimates.of_metrics(figures.metrics())
    names = [*recomputed(made_episodes(2)), "success_rate"]
    assert {name: again.estimates[name] for name in names} == {name: figures.estimates[name] for name in names}
    assert (again.n_volumes, again.n_episodes, again.on_plane) == (4, 24, (OnPlane(5, 10), OnPlane(2, 5)))


def test_number_of_volumes_that_was_not_tracked_is_not_shown():
    figures = MetricEstimates.of_metrics({"success_rate": 0.5, "episodes": 4})
    (row,) = [line for line in ResultTable({"agent": figures}).markdown().splitlines() if "volumes" in line]
    assert "0" not in row


def test_figures_of_older_runs_are_shown_without_intervals():
    old = {"success_rate": 0.5, "mean_steps": 9.25, "mean_distance_mm": 3.0, "mean_dice": 0.4}
    table = ResultTable({"agent": MetricEstimates.of_metrics(old)})
    titles = ["success, by reward", "steps, mean", "distance mm, mean", "Dice, mean"]
    assert [column.title for column in table.quantities] == titles
    assert "| steps, mean | 9.25 |" in table.markdown().replace("9.25  |", "9.25 |")


def test_a_few_results_stand_side_by_side_in_80_columns():
    figures = MetricEstimates.of(Evaluation(made_episodes(3)))
    names = ["agent, test", "random, test", "sweep 5 mm, test", "agent, validation", "agent, training"]
    shown = text_of(ResultTable(dict.fromkeys(names, figures)).show(80), 80)
    assert max(map(len, shown.splitlines())) <= 80
    assert shown.count("90th percentile") == 2 * shown.count("IQM")
    assert shown.count("validation") == 1
    assert f"{recomputed(made_episodes(3))[PLANE]:.1%}" in shown


def test_many_results_are_lines_and_what_does_not_fit_is_named():
    figures = MetricEstimates.of(Evaluation(made_episodes(3)))
    results = {f"05001_labels_{number}.nii.gz": figures for number in range(9)}
    narrow, wide = (text_of(ResultTable(results).show(width), width) for width in (80, 300))
    assert max(map(len, narrow.splitlines())) <= 80
    assert all(name in narrow for name in results)
    assert "not shown at 80 characters: " in narrow
    assert "not shown" not in wide
    assert "artery" in wide


def test_page_has_a_column_for_each_of_a_few_results_and_a_line_for_each_of_many():
    figures = MetricEstimates.of(Evaluation(made_episodes(3)))
    few, many = (ResultTable({str(number): figures for number in range(n)}).html() for n in (2, 9))
    assert '<tr><td data-label=""><div>steps, mean</div></td><td data-label="0"><div>' in few
    assert '<td data-label="steps, mean"><div>' in many
    assert few.count("<tr>") == 1 + few.count('data-label=""') == 1 + few.count('data-label="1"')
    assert many.count("<tr>") == 1 + 9
    of_jobs = ResultTable({str(number): figures for number in range(9)}, {"run": ["4f2a"] * 9, "outcome": ["done"] * 9})
    assert of_jobs.html().count("<small>4f2a, done</small>") == 9


def test_names_are_no_markup():
    figures = MetricEstimates.of(evaluation_of(2))
    table = ResultTable({"projection=[rz,ty]": figures}, {"overrides": ["<b>[red]"]})
    assert "projection=[rz,ty]" in text_of(table.show(200), 200)
    assert "&lt;b&gt;[red]" in table.html()
    html.parser.HTMLParser().feed(table.html())


def test_equal_baselines_are_shown_once():
    ours, other = (MetricEstimates.of(evaluation_of(steps)) for steps in (2, 3))
    results = {"0": ours, "1": other}
    assert list(with_baselines(results, {"0": {"random": ours}, "1": {"random": ours}})) == ["0", "1", "random"]


def test_jobs_keep_the_leading_figures_at_80_columns_and_their_words_stand_below():
    figures = MetricEstimates.of(Evaluation(made_episodes(0)))
    words = ["agent=sac network.vector.hidden_sizes=[256,256]", "agent=ppo network.vector.hidden_sizes=[64,64]"]
    table = ResultTable({"0": figures, "1": figures}, {"run": ["4f2a1b3c", "91c0aaaa"], "overrides": words})
    lines = text_of(table.lines(80), 80).splitlines()
    assert max(map(len, lines)) <= 80
    head = " ".join(lines[:4])
    for heading in ("on plane", "distance mm", "angle °", "success", "steps"):
        assert heading in head
    assert f"1: 91c0aaaa, {words[1]}" in lines
    # If there is room, they are columns.
    assert "1: " not in text_of(table.lines(200), 200)
