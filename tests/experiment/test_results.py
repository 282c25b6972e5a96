"""The result of a run in its table."""

from dataclasses import replace

import pytest

from armscan.experiment.results import RunResult, evaluation_table, volume_notes
from armscan.training import TEST, TRAINING, Evaluation, MetricEstimates, ResultTable
from tests.training.test_result_table import made_episodes


def test_agent_that_is_a_baseline_has_one_row():
    test, training, baseline = (Evaluation(made_episodes(seed)) for seed in range(3))
    played = {TRAINING: training, TEST: test}
    alone = RunResult(played, {"random": baseline}, own_baseline="random")
    assert list(alone.table().results) == ["agent, test", "agent, training"]
    beside = RunResult(played, {"random": baseline})
    assert list(beside.table().results) == ["agent, test", "random, test", "agent, training"]


@pytest.mark.parametrize(
    ("n_test", "n_validation", "few"),
    [
        (8, 8, None),
        (8, None, None),
        (8, 4, "4 validation subjects"),
        (1, 4, "1 test subject and 4 validation subjects"),
    ],
)
def test_few_volumes_are_said_in_one_line(n_test, n_validation, few):
    test, validation = (
        MetricEstimates.of(Evaluation(made_episodes(0, n_volumes=n))) if n else None for n in (n_test, n_validation)
    )
    notes = volume_notes(test, validation)
    assert [note.partition(", fewer than 8")[0] for note in notes] == ([few] if few else [])


@pytest.mark.parametrize("is_first", [True, False])
def test_subjects_are_those_of_the_evaluations_that_know_them(is_first):
    older = made_episodes(0, n_volumes=8)
    newer = tuple(replace(each, subject=str(int(each.volume[1:]) // 2)) for each in older)
    evaluations = [Evaluation(newer), Evaluation(older)]
    figures = MetricEstimates.of_trainings(dict(enumerate(evaluations if is_first else reversed(evaluations))))
    assert (figures.n_volumes, figures.n_subjects) == (8, 4)


def test_volumes_of_one_subject_are_one_wrist():
    of_pairs = tuple(replace(each, subject=str(int(each.volume[1:]) // 2)) for each in made_episodes(0, n_volumes=8))
    figures = MetricEstimates.of(Evaluation(of_pairs))
    assert volume_notes(figures)[0].startswith("4 test subjects, fewer than 8")
    assert "8 (4 subjects)" in ResultTable({"agent": figures}).markdown()
    of_pair_names = tuple(replace(each, volume=each.subject, subject=None) for each in of_pairs)
    assert figures.estimates == MetricEstimates.of(Evaluation(of_pair_names)).estimates


def test_validation_that_no_interval_shares_with_the_test_is_said_in_one_line():
    on_plane, off_plane = (
        MetricEstimates.of(Evaluation([replace(each, distance_mm=mm, distance_deg=0.0) for each in made_episodes(0)]))
        for mm in (0.0, 50.0)
    )
    few, apart = volume_notes(on_plane, off_plane)
    assert few.startswith("4 test subjects and 4 validation subjects, fewer than 8")
    assert "0% on the validation and 100% on the test volumes, and the intervals do not overlap" in apart


def test_table_of_an_evaluation_names_the_volumes_of_each_figure():
    groups = ("train_split", "test_split", "random/test_split", "volume/a", "volume/a/b")
    metrics = {f"{group}/success_rate": number / 10 for number, group in enumerate(groups)}
    table = evaluation_table(metrics)
    assert {title: figures.estimate("success_rate").value for title, figures in table.results.items()} == {
        "agent, train split": 0.0,
        "agent, test split": 0.1,
        "random, test split": 0.2,
    }
