"""Outboxes: files in the folders of runs that hold what is to be tracked."""

import json
import multiprocessing
import time
from unittest.mock import Mock

import pytest

from armscan.errors import FolderInUseError, TrackingError
from armscan.tracking.outbox import Address, Outbox, file_of, outbox_files, take_over
from tests.support.waiting import HANG_S

ADDRESS = Address("a" * 32, "sqlite:///runs.db")


@pytest.fixture
def outbox(tmp_path):
    outbox = Outbox.begin(tmp_path, ADDRESS)
    yield outbox
    outbox.close()


def kinds(entries):
    return [next(iter(entry)) for entry in entries]


def test_outbox_keeps_entries_in_their_order_and_what_is_uploaded_of_each_channel(outbox, tmp_path):
    outbox.add(tags={"a": "b"})
    outbox.add(file="best.pt")
    outbox.add(metrics=[("x", 1.0, 5, 100)])
    figures, end = outbox.next_entries("figures", 10)
    assert kinds(figures) == ["address", "tags", "metrics"]
    assert figures[2]["metrics"] == [["x", 1.0, 5, 100]]
    assert outbox.next_entries("files", 10)[0] == [{"file": "best.pt"}]
    outbox.mark("figures", end)
    outbox.close()
    again = Outbox.begin(tmp_path, ADDRESS)
    assert again.next_entries("figures", 10)[0] == []
    assert not again.is_uploaded
    again.mark("files", again.next_entries("files", 10)[1])
    assert again.is_uploaded
    again.add(status=("FINISHED", 7))
    assert (again.is_uploaded, again.status) == (False, "FINISHED")
    again.close()


def test_outbox_gives_no_more_entries_than_asked_for(outbox):
    for step in range(5):
        outbox.add(metrics=[("x", 1.0, 5, step)])
    first, end = outbox.next_entries("figures", 3)
    outbox.mark("figures", end)
    rest, _ = outbox.next_entries("figures", 10)
    assert (len(first), len(rest)) == (3, 3)


def test_outbox_reads_entries_of_the_other_channel_once(outbox, monkeypatch):
    outbox.add(metrics=[("x", 1.0, 5, 100)])
    assert outbox.next_entries("files", 1)[0] == []
    parse = Mock(wraps=json.loads)
    monkeypatch.setattr(json, "loads", parse)
    outbox.add(file="best.pt")
    assert outbox.next_entries("files", 1)[0] == [{"file": "best.pt"}]
    parse.assert_called_once()


def test_outbox_cuts_off_a_line_whose_writer_died(outbox, tmp_path):
    outbox.add(tags={"a": "b"})
    outbox.close()
    with outbox.file.open("ab") as file:
        file.write(b'{"metrics": [["x", 1.')
    again = Outbox.begin(tmp_path, ADDRESS)
    again.add(status=("FINISHED", 7))
    assert kinds(again.entries()) == ["address", "tags", "status"]
    again.close()


@pytest.mark.parametrize("damage", [b"nonsense\n", b"[1]\n", b'{"\xff": 1}\n'])
def test_outbox_names_a_damaged_line(outbox, damage):
    with outbox.file.open("ab") as file:
        file.write(damage)
    with pytest.raises(TrackingError, match=f"{outbox.file}: a line is damaged"):
        list(outbox.entries())


@pytest.mark.parametrize("contents", [b"", b'{"tags": {}}\n', b'{"address": {"run": 1}}\n', b'{"address": 3}\n'])
def test_outbox_names_a_file_that_does_not_say_what_it_is_of(tmp_path, contents):
    file = file_of(tmp_path, "b" * 32)
    file.parent.mkdir()
    file.write_bytes(contents)
    with pytest.raises(TrackingError, match="does not begin with the ID of its run"):
        Outbox(file)
    # An outbox that could not be opened is not locked.
    file.write_bytes(json.dumps({"address": {"run_id": "b" * 32, "uri": "c"}}).encode() + b"\n")
    Outbox(file, timeout_s=0.0).close()


def test_outbox_that_names_another_run_than_its_file_is_not_opened(outbox, tmp_path):
    file = file_of(tmp_path, "b" * 32)
    outbox.file.rename(file)
    with pytest.raises(TrackingError, match=f"{file}: begins with the ID of another run, {ADDRESS.run_id}"):
        Outbox(file)


@pytest.mark.parametrize(
    "said",
    ["{", "[]", "5", *(f'{{"figures": {end}, "files": {end}}}' for end in ("99999999", "-5", '"x"', "7", "true"))],
)
def test_outbox_uploads_all_again_where_nobody_knows_what_was_uploaded(outbox, tmp_path, said):
    outbox.mark("figures", outbox.next_entries("figures", 10)[1])
    outbox.file.with_suffix(".delivered.json").write_text(said)
    outbox.close()
    again = Outbox.begin(tmp_path, ADDRESS)
    assert kinds(again.next_entries("figures", 10)[0]) == ["address"]
    again.close()


def hold(folder, is_held):
    held = Outbox.begin(folder, ADDRESS)
    is_held.set()
    time.sleep(HANG_S)
    held.close()


def test_outbox_is_held_by_one_process_until_that_dies(tmp_path):
    context = multiprocessing.get_context("spawn")
    is_held = context.Event()
    process = context.Process(target=hold, args=(tmp_path, is_held))
    process.start()
    assert is_held.wait(HANG_S)
    with pytest.raises(FolderInUseError, match="another process tracks this run"):
        Outbox(file_of(tmp_path, ADDRESS.run_id), timeout_s=0.0)
    process.kill()
    process.join()
    Outbox(file_of(tmp_path, ADDRESS.run_id), timeout_s=5.0).close()


def test_outbox_is_taken_over_with_what_is_uploaded_of_it(outbox, tmp_path):
    outbox.add(tags={"a": "b"})
    outbox.mark("figures", outbox.next_entries("figures", 1)[1])
    outbox.close()
    take_over(ADDRESS.run_id, tmp_path, tmp_path / "retry")
    assert outbox_files(tmp_path) == [file_of(tmp_path / "retry", ADDRESS.run_id)]
    again = Outbox.begin(tmp_path / "retry", ADDRESS)
    assert kinds(again.next_entries("figures", 10)[0]) == ["tags"]
    again.close()
    take_over("c" * 32, tmp_path, tmp_path / "retry")


def test_outbox_that_is_not_there_is_not_made(tmp_path):
    with pytest.raises(FileNotFoundError):
        Outbox(file_of(tmp_path / "gone", ADDRESS.run_id))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["outbox.jsonl", "outbox.delivered.json", "outbox.lock", ""])
def test_outbox_that_is_a_link_is_not_opened_and_what_it_leads_to_stays(tmp_path, name):
    folder, precious = tmp_path / "theirs" / "tracking", tmp_path / "precious"
    folder.mkdir(parents=True)
    file = folder / "outbox.jsonl"
    precious.write_text("no line that ends")
    if name:
        file.write_text("{}\n")
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(precious)
    else:
        folder.rmdir()
        (tmp_path / "other").mkdir()
        folder.symlink_to(tmp_path / "other")
        file.write_text("{}\n")
    with pytest.raises(TrackingError, match="is a link, but outboxes are files of the run's own folder"):
        Outbox(file, timeout_s=0.0)
    assert precious.read_text() == "no line that ends"


def test_entry_of_which_a_full_disk_took_a_part_leaves_no_partial_line(outbox, monkeypatch):
    outbox.add(tags={"a": "b"})
    appending = outbox._appending
    monkeypatch.setattr(outbox, "_appending", Mock(wraps=appending, write=lambda line: appending.write(line[:5])))
    with pytest.raises(OSError, match="No space left on device"):
        outbox.add(tags={"c": "d"})
    monkeypatch.setattr(outbox, "_appending", appending)
    outbox.add(tags={"e": "f"})
    assert [entry["tags"] for entry in outbox.entries() if "tags" in entry] == [{"a": "b"}, {"e": "f"}]


def test_status_of_a_run_is_its_last(outbox):
    assert outbox.status is None
    for status in ("RUNNING", "FAILED"):
        outbox.add(status=(status, 7))
    assert outbox.status == "FAILED"
