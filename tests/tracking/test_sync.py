"""A run with several outboxes, one for each command of its study: the latest status and description stay."""

import contextlib
import json

import pytest
from mlflow import MlflowClient

from armscan.tracking import open_existing_store, open_store, sync
from armscan.tracking.outbox import Address, Outbox, file_of
from armscan.tracking.run_end import begin_outbox
from armscan.tracking.sync import IN_USE, _upload_pending


@pytest.fixture
def run_id(database, tmp_path, monkeypatch):
    monkeypatch.setenv("ARMSCAN_CACHE", str(tmp_path / "cache"))
    store, experiment_id = open_store(database, experiment="test", artifacts=str(tmp_path), wait_s=60.0)
    return store.create_run(experiment_id, name="study", tags={}).info.run_id


def add_command(database, run_id, folder, *, at_ms, status, reason=None, note=None, value=None):
    """Add the outbox of a command that could not upload anything."""
    with contextlib.closing(Outbox.begin(folder, Address(run_id, database))) as outbox:
        outbox.add(status=("RUNNING", at_ms))
        outbox.add(untagged="failure")
        outbox.add(metrics=[["value", value or 0.0, at_ms, 0]])
        if note is not None:
            outbox.add(note=note)
        outbox.add(**({"tags": {"failure": reason}} if reason else {"untagged": "failure"}))
        outbox.add(status=(status, at_ms + 10))


def upload_all(folder):
    return sync(folder, open_existing_store, trust=True)


def result_of(database, run_id):
    run = MlflowClient(database).get_run(run_id)
    tags, metrics = run.data.tags, run.data.metrics
    return run.info.status, run.info.end_time, tags.get("failure"), tags.get("mlflow.note.content"), metrics["value"]


@pytest.mark.parametrize("names", [("1", "2", "3"), ("2", "3", "1"), ("3", "2", "1")])
@pytest.mark.parametrize("who", ["a start", "runs sync"])
@pytest.mark.parametrize("is_uploaded", [False, True])
def test_outbox_of_an_earlier_command_leaves_the_later_result(database, run_id, tmp_path, names, who, is_uploaded):
    first, second, last = (tmp_path / name for name in names)
    add_command(database, run_id, last, at_ms=3_000, status="FINISHED", note="the result", value=0.3)
    if is_uploaded:
        upload_all(tmp_path)
    add_command(database, run_id, first, at_ms=1_000, status="KILLED", reason="by hand", note="old", value=0.1)
    add_command(database, run_id, second, at_ms=2_000, status="FAILED", reason="worse", value=0.2)
    # Of the commands of a study, the last to begin is the one that is pending; it may not be the last to end.
    begin_outbox(second, run_id, database).close()
    if who == "a start":
        _upload_pending(open_existing_store(database))
    else:
        assert not any(each.left for each in sync(tmp_path, open_existing_store))
    assert result_of(database, run_id) == ("FINISHED", 3_010, None, "the result", 0.3)
    assert upload_all(tmp_path) == []


def test_description_stays_where_the_later_command_has_none(database, run_id, tmp_path):
    add_command(database, run_id, tmp_path / "2", at_ms=2_000, status="KILLED", reason="by hand", value=0.2)
    upload_all(tmp_path)
    add_command(database, run_id, tmp_path / "1", at_ms=1_000, status="FINISHED", note="the result", value=0.1)
    upload_all(tmp_path)
    assert result_of(database, run_id) == ("KILLED", 2_010, "by hand", "the result", 0.2)


def test_outbox_of_an_earlier_command_waits_for_one_in_progress(database, run_id, tmp_path):
    add_command(database, run_id, tmp_path / "1", at_ms=1_000, status="KILLED", reason="by hand", note="old")
    add_command(database, run_id, tmp_path / "2", at_ms=2_000, status="FINISHED", note="the result", value=0.2)
    with contextlib.closing(Outbox(file_of(tmp_path / "2", run_id))):
        assert [each.left for each in upload_all(tmp_path)] == [IN_USE, IN_USE]
    upload_all(tmp_path)
    assert result_of(database, run_id) == ("FINISHED", 2_010, None, "the result", 0.2)


def test_interrupted_upload_of_an_earlier_outbox_is_made_good(database, run_id, tmp_path, monkeypatch):
    add_command(database, run_id, tmp_path / "2", at_ms=2_000, status="FINISHED", note="the result", value=0.2)
    upload_all(tmp_path)
    add_command(database, run_id, tmp_path / "1", at_ms=1_000, status="KILLED", reason="by hand", note="old")

    class KilledError(BaseException):
        """As if the process was killed."""

    def killed(*_):
        raise KilledError

    # After everything of the earlier command is in the store.
    mark = Outbox.mark
    monkeypatch.setattr(Outbox, "mark", lambda outbox, channel, end: killed() if end else mark(outbox, channel, end))
    with pytest.raises(KilledError):
        upload_all(tmp_path)
    monkeypatch.undo()
    assert json.loads(file_of(tmp_path / "2", run_id).with_suffix(".delivered.json").read_text())["figures"] == 0
    upload_all(tmp_path)
    assert result_of(database, run_id) == ("FINISHED", 2_010, None, "the result", 0.2)


@pytest.mark.parametrize("link", ["", "tracking", "tracking/{}.jsonl"])
def test_link_beside_an_outbox_is_not_followed(database, run_id, tmp_path, tmp_path_factory, link):
    add_command(database, run_id, tmp_path / "1", at_ms=1_000, status="FINISHED", note="the result")
    target = tmp_path_factory.mktemp("user") / "2" / "tracking" / f"{run_id}.jsonl"
    target.parent.mkdir(parents=True)
    target.write_bytes(bytes(200))
    place = tmp_path / "2" / link.format(run_id)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(target.parents[1] / link.format(run_id))
    assert file_of(tmp_path / "2", run_id).read_bytes() == bytes(200)
    begin_outbox(tmp_path / "1", run_id, database).close()
    sync(tmp_path, open_existing_store)
    assert result_of(database, run_id)[0] == "FINISHED"
    assert target.read_bytes() == bytes(200)
    assert [each.name for each in target.parent.iterdir()] == [target.name]


@pytest.mark.parametrize(
    "damage", [b"", b"nonsense", b'{"address": 3}\n', b'{"status": []}\n', b'{"status": ["FINISHED", "9"]}\n']
)
def test_damaged_outbox_does_not_stop_the_others_of_the_run(database, run_id, tmp_path, damage):
    add_command(database, run_id, tmp_path / "1", at_ms=1_000, status="FINISHED", note="the result", value=0.1)
    add_command(database, run_id, tmp_path / "2", at_ms=2_000, status="KILLED")
    file = file_of(tmp_path / "2", run_id)
    file.write_bytes(file.read_bytes() + damage if b"status" in damage else damage)
    lefts = [each.left for each in upload_all(tmp_path)]
    assert lefts[0] is None
    assert str(file) in lefts[1]
    assert result_of(database, run_id)[::3] == ("FINISHED", "the result")
