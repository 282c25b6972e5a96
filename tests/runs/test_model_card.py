"""Descriptions of registered policies: the latest figures, or a note that a file is damaged."""

import json

import pytest

from armscan.agents.policy import SAMPLING
from armscan.errors import TrackingError
from armscan.evaluation import EvaluationReport
from armscan.runs.model_card import MAX_CHARS, Card
from armscan.tracking import TrackedRun, load_run
from armscan.tracking.tags import EVALUATED_TAG
from armscan.utils.files import sha256
from armscan.utils.run_files import RESULT_SHA256_TAGS
from tests.support.stores import store_in
from tests.support.tracked_runs import store_of
from tests.training.test_train import evaluation_of

OWN = {"test volumes": evaluation_of(2, 4).to_dict()}
FACTS = {"data": "configured volumes", "changes": {"success_threshold": 0.2}}
BY_COMMAND = EvaluationReport({"test volumes": evaluation_of(6)}, has_total=False, facts=FACTS).to_dict()


@pytest.fixture
def keep(tmp_path, database):
    """Track a run with a file, as an evaluation of another run or of none; return its ID."""
    store, experiment_id = store_in(tmp_path, "test")

    def kept(name, text, of=None):
        (tmp_path / name).write_text(text)
        tags = {EVALUATED_TAG: of} if of else {}
        with TrackedRun.start(store, experiment_id, name="n", config={}, tags=tags, folder=tmp_path) as run:
            run.log_files(tmp_path / name)
        return run.run_id

    return kept


def card_of(run_id, tmp_path, differs=None):
    folder = tmp_path / "fetched"
    folder.mkdir(exist_ok=True)
    return Card.of(load_run(f"sqlite:///{tmp_path}/mlruns.db", run_id), folder, differs)


def test_card_has_the_latest_evaluation_that_has_kept_its_figures(keep, tmp_path):
    run_id = keep("evaluation.json", json.dumps(OWN))
    earlier, latest = (keep("figures.json", json.dumps(BY_COMMAND | {"data": data}), run_id) for data in ("a", "b"))
    # As `out=figures.txt` left it in earlier versions.
    keep("figures.txt", json.dumps(BY_COMMAND), run_id)
    card = card_of(run_id, tmp_path)
    assert f"### by evaluation {latest}, on b, success_threshold=0.2\n" in card.text
    assert earlier not in card.text
    assert "| steps, mean | 3.00 (2.00–4.00) |" in card.text
    # The tags are of the run's own evaluation, by its own rules.
    assert card.tags["test_volumes/mean_steps"] == "3"


def test_evaluation_of_another_run_is_refused(keep, tmp_path):
    run_id = keep("evaluation.json", json.dumps(OWN))
    store_of(tmp_path).set_tag(run_id, RESULT_SHA256_TAGS["evaluation.json"], sha256(b"another"))
    with pytest.raises(TrackingError, match=r"its evaluation\.json is damaged"):
        card_of(run_id, tmp_path)


@pytest.mark.parametrize(("n_notes", "is_there"), [(2, True), (20, False)])
def test_card_shortens_long_notes_and_says_which_evaluation_it_has_no_room_for(keep, tmp_path, n_notes, is_there):
    run_id = keep("evaluation.json", json.dumps(OWN))
    notes = ["the agent was trained on these volumes: " + ", ".join(f"wrist-{i}" for i in range(300))] * n_notes
    latest = keep("figures.json", json.dumps(BY_COMMAND | {"notes": notes}), run_id)
    text = card_of(run_id, tmp_path).text
    assert len(text) <= MAX_CHARS
    assert text.count("### at the end of the run") == 1
    assert text.count("Note: the agent was trained on these volumes: wrist-0, ") == (n_notes if is_there else 0)
    assert (f"### by evaluation {latest}" in text) is is_there
    assert (f"Left out, because it is too long: by evaluation {latest}, on " in text) is not is_there


@pytest.mark.parametrize(
    "contents",
    [
        "",
        "[]",
        "{}",
        '{"a": 1}',
        '{"a": {}}',
        '{"a": {"episodes": []}}',
        '{"a": {"episodes": {}}}',
        '{"a": {"episodes": [1]}}',
        *(
            json.dumps({"a": {"episodes": [OWN["test volumes"]["episodes"][0] | changed]}})
            for changed in (
                {"n_steps": "many"},
                {"n_steps": True},
                {"is_success": 1},
                {"volume": 3},
                {"distance_mm": float("nan")},
                {"distance_mm": float("inf")},
                {"n_steps": 10**400},
                {"new": 1},
            )
        ),
    ],
)
def test_damaged_evaluation_of_a_run_is_one_line(keep, tmp_path, contents):
    run_id = keep("evaluation.json", contents)
    with pytest.raises(TrackingError, match=rf"^run {run_id}: its evaluation\.json is damaged; put it back, or remove"):
        card_of(run_id, tmp_path)


@pytest.mark.parametrize(
    "contents",
    [
        {},
        [],
        BY_COMMAND | {"splits": 5},
        BY_COMMAND | {"changes": []},
        BY_COMMAND | {"data": 1},
        BY_COMMAND | {"episodes": {"test volumes": []}},
    ],
)
def test_damaged_evaluation_by_the_command_is_one_line(keep, tmp_path, contents):
    run_id = keep("evaluation.json", json.dumps(OWN))
    latest = keep("figures.json", json.dumps(contents), run_id)
    with pytest.raises(
        TrackingError, match=rf"^run {latest}: its figures\.json is damaged; put it back, or remove it$"
    ):
        card_of(run_id, tmp_path)


@pytest.mark.parametrize("has_total", [False, True])
def test_card_pools_volumes_only_where_the_evaluation_did_and_has_its_notes(keep, tmp_path, has_total):
    run_id = keep("evaluation.json", json.dumps(OWN))
    facts = FACTS | {"data": "folder", "notes": ["the agent was trained on these volumes"]}
    splits = {"train split": evaluation_of(1), "test split": evaluation_of(9)}
    keep("figures.json", json.dumps(EvaluationReport(splits, has_total=has_total, facts=facts).to_dict()), run_id)
    card = card_of(run_id, tmp_path)
    assert ("all volumes" in card.text) == has_total
    # Its episodes have other rules, which a tag would not tell.
    assert "all_volumes/mean_steps" not in card.tags
    assert "Note: the agent was trained on these volumes." in card.text
    assert "Note: 1 subject, fewer than 8: the intervals are too narrow for other subjects" in card.text


def test_tags_of_a_run_without_an_evaluation_of_its_own_are_those_of_the_latest_by_its_rules(keep, tmp_path):
    run_id = keep("notes.txt", "")
    keep("figures.json", json.dumps(BY_COMMAND | {"changes": {}}), run_id)
    assert card_of(run_id, tmp_path).tags["test_volumes/mean_steps"] == "6"


def test_later_evaluation_by_changed_rules_takes_no_figures_from_the_card(keep, tmp_path):
    run_id = keep("notes.txt", "")
    earlier, unchanged, changed = (
        keep("figures.json", json.dumps(BY_COMMAND | {"changes": changes, "data": data}), run_id)
        for data, changes in (("a", {}), ("b", {}), ("c", {"max_steps": 3}))
    )
    card = card_of(run_id, tmp_path)
    assert card.tags["test_volumes/mean_steps"] == "6"
    assert f"### by evaluation {unchanged}, on b\n" in card.text
    assert f"### by evaluation {changed}, on c, max_steps=3\n" in card.text
    assert earlier not in card.text


def test_card_of_a_policy_that_acts_otherwise_than_its_agent_says_so(keep, tmp_path):
    run_id = keep("evaluation.json", json.dumps(OWN))
    assert "not been evaluated" not in card_of(run_id, tmp_path).text
    assert f"Note: this policy has not been evaluated; {SAMPLING}." in card_of(run_id, tmp_path, SAMPLING).text
