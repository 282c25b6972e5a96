"""Runs in MLflow's UI: columns, best figures, pruned trials, datasets."""

import json
from functools import partial

import pytest
from mlflow.entities import Metric, Param

from armscan.launch.best_job import log_best
from armscan.stats.on_plane import leading_of
from armscan.tracking import TrackedRun
from armscan.tracking.tags import BEST_TAG
from armscan.tracking.uploader import set_description
from armscan.tracking.view import VIEW, VIEW_TAG
from tests.support.stores import store_in

RATE, STEPS = "test_volumes/on_plane_5mm_10deg", "test_volumes/mean_steps"
RANDOM_RATE = "random/on_plane_5mm_10deg"


@pytest.fixture
def store(tmp_path):
    return partial(store_in, tmp_path, "a")


@pytest.fixture
def tracked(store, tmp_path):
    client, experiment_id = store()
    with TrackedRun.start(client, experiment_id, name="a-0001", config={}, tags={}, folder=tmp_path) as started:
        yield started


def run_of(tracked, store):
    """End a run; return it as the store has it."""
    assert tracked.end("FINISHED")
    return store()[0].get_run(tracked.run_id)


def test_experiment_has_the_view_also_where_it_was_made_before(store):
    client, experiment_id = store()
    assert client.get_experiment(experiment_id).tags[VIEW_TAG] == VIEW
    client.set_experiment_tag(experiment_id, VIEW_TAG, "{}")
    store()
    assert client.get_experiment(experiment_id).tags[VIEW_TAG] == VIEW


def test_view_leads_with_the_on_plane_rate_and_its_curve():
    view = json.loads(VIEW)
    assert view["selectedColumns"][0] == f"metrics.`{RATE}`"
    assert view["selectedColumns"][1] == f"metrics.`{RANDOM_RATE}`"
    assert view["columnOrder"] == view["selectedColumns"] == [*view["columnWidths"]]
    (section,) = view["compareRunSections"]
    first = view["compareRunCharts"][0]
    assert (first["metricKey"], first["type"]) == ("validation/on_plane_5mm_10deg", "LINE")
    assert {chart["metricSectionId"] for chart in view["compareRunCharts"]} == {section["uuid"]}


def test_run_of_a_grid_shows_the_figures_of_its_best_job(store):
    client, experiment_id = store()
    parent, *jobs = (client.create_run(experiment_id, name=name, tags={}).info.run_id for name in ("parent", "a", "b"))
    for job, rate in zip(jobs, (0.25, 0.75), strict=True):
        metrics = [
            Metric(RATE, rate, 1, 5),
            Metric(RANDOM_RATE, 0.2, 1, 5),
            Metric(STEPS, 4 * rate, 1, 5),
            Metric(f"{RATE}_low", 0.1, 1, 5),
        ]
        client.log_batch(job, metrics=metrics)
    log_best(client, parent, [client.get_run(job) for job in jobs])
    run = client.get_run(parent)
    assert run.data.metrics == {RATE: 0.75, STEPS: 3.0, RANDOM_RATE: 0.2}
    assert run.data.tags[BEST_TAG] == jobs[1]


@pytest.mark.parametrize("key", ["data.fold", "projection", "data.path", "data.version", "env.transform.ty_mm"])
def test_run_of_a_grid_over_tasks_shows_no_best_job(store, key):
    client, experiment_id = store()
    parent, *jobs = (client.create_run(experiment_id, name=name, tags={}).info.run_id for name in ("parent", "a", "b"))
    for number, job in enumerate(jobs):
        client.log_batch(job, metrics=[Metric(RATE, 0.5, 1, 5)], params=[Param(key, str(number))])
    log_best(client, parent, [client.get_run(job) for job in jobs])
    assert client.get_run(parent).data.metrics == {}


@pytest.mark.parametrize("projections", [("y", "y"), ("y", "zy")])
def test_run_of_a_grid_has_the_limits_of_its_jobs(store, projections):
    client, experiment_id = store()
    parent, *jobs = (client.create_run(experiment_id, name=name, tags={}).info.run_id for name in ("parent", "a", "b"))
    for job, projection in zip(jobs, projections, strict=True):
        params = [Param("evaluation.on_plane", "[[2, 5]]"), Param("projection", projection)]
        client.log_batch(job, metrics=[Metric("test_volumes/on_plane_2mm_5deg", 0.5, 1, 5)], params=params)
    log_best(client, parent, [client.get_run(job) for job in jobs])
    assert leading_of(client.get_run(parent).data.params) == (2, 5)


def test_run_of_a_grid_without_evaluated_jobs_shows_nothing(store):
    client, experiment_id = store()
    parent = client.create_run(experiment_id, name="parent", tags={}).info.run_id
    log_best(client, parent, [client.get_run(parent)])
    assert client.get_run(parent).data.metrics == {}


def test_pruned_run_says_so_in_its_name(tracked, store):
    tracked.set_pruned()
    run = run_of(tracked, store)
    assert (run.info.run_name, run.data.tags["pruned"]) == ("a-0001 (pruned)", "true")


def test_volumes_are_datasets_with_a_digest_of_their_fingerprints(tracked, store):
    tracked.log_datasets({"training": {"a": "1" * 64, "b": "2" * 64}, "test": {"b": "2" * 64, "a": "1" * 64}, "x": {}})
    inputs = {each.dataset.name: each for each in run_of(tracked, store).inputs.dataset_inputs}
    assert {name: each.tags[0].value for name, each in inputs.items()} == {
        "training volumes": "training",
        "test volumes": "test",
    }
    assert len({each.dataset.digest for each in inputs.values()}) == 1
    assert json.loads(inputs["training volumes"].dataset.source) == {"volumes": "a b"}


def test_best_checkpoint_is_a_model_with_metrics_of_its_run_and_their_volumes_once(tracked, store):
    tracked.log_datasets({"test": {"a": "1" * 64}})
    tracked.log_metrics({RATE: 0.5, STEPS: 3.0}, n_env_steps=7)
    for _ in range(2):
        # As where a server has not answered: an entry is uploaded again.
        tracked.log_model({"test": [RATE, "test_volumes/none"]}, n_env_steps=7)
    run = run_of(tracked, store)
    client, experiment_id = store()
    (found,) = client.search_logged_models([experiment_id])
    model = client.get_logged_model(found.model_id)
    assert (model.name, str(model.status), model.source_run_id) == ("a-0001", "READY", run.info.run_id)
    assert [(each.key, each.value, each.step, each.dataset_name) for each in model.metrics] == [
        (RATE, 0.5, 7, "test volumes")
    ]
    assert [(each.model_id, each.step) for each in run.outputs.model_outputs] == [(model.model_id, 7)]
    # The run's own metrics stay as they are.
    assert len(client.get_metric_history(run.info.run_id, RATE)) == 1


def test_description_of_a_run_is_its_table_unless_somebody_wrote_one(tracked, store, tmp_path):
    client, experiment_id = store()
    tracked.set_description("| table |")
    assert run_of(tracked, store).data.tags["mlflow.note.content"] == "| table |"
    with TrackedRun.start(client, experiment_id, name="b", config={}, tags={}, folder=tmp_path / "b") as other:
        client.set_tag(other.run_id, "mlflow.note.content", "mine")
        other.set_description("| table |")
    assert client.get_run(other.run_id).data.tags["mlflow.note.content"] == "mine"


def test_description_of_a_grid_follows_its_table_unless_somebody_wrote_one(store):
    client, experiment_id = store()
    run_id = client.create_run(experiment_id, name="multirun", tags={}).info.run_id
    for table in ("early", "late"):
        set_description(client, run_id, table)
        assert client.get_run(run_id).data.tags["mlflow.note.content"] == table
    client.set_tag(run_id, "mlflow.note.content", "mine")
    set_description(client, run_id, "latest")
    assert client.get_run(run_id).data.tags["mlflow.note.content"] == "mine"


def test_description_follows_a_result_that_changes(store, tmp_path):
    client, experiment_id = store()
    with TrackedRun.start(client, experiment_id, name="a", config={}, tags={}, folder=tmp_path) as first:
        first.set_description("early")
    with TrackedRun.open_existing(client, first.run_id, name="a", folder=tmp_path) as again:
        again.set_description("late")
    assert client.get_run(first.run_id).data.tags["mlflow.note.content"] == "late"
