"""Storages of studies: opened, locked, repaired."""

import json
import multiprocessing
import os
import sqlite3
import time
from contextlib import closing

import optuna
import pytest

from armscan.errors import InvalidValueError, StudyError
from armscan.sweeps.storage.storage import existing_storage, open_storage


def test_storage_keeps_a_study_for_the_next_process(storage_uri):
    study = optuna.create_study(study_name="a", storage=open_storage(storage_uri).optuna)
    study.tell(study.ask(), 3.0)
    again = optuna.load_study(study_name="a", storage=open_storage(storage_uri).optuna)
    assert [trial.value for trial in again.trials] == [3.0]


def count_up(uri, path, n):
    def count():
        before = int(path.read_text())
        time.sleep(0.002)
        path.write_text(str(before + 1))

    storage = open_storage(uri)
    for _ in range(n):
        storage.exclusive(count)


def test_storage_lets_one_process_alone_at_a_time(storage_uri, tmp_path):
    count = tmp_path / "count"
    count.write_text("0")
    processes = [multiprocessing.Process(target=count_up, args=(storage_uri, count, 20)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert count.read_text() == "60"


@pytest.mark.parametrize("kept", [1, 10, -2])
def test_journal_that_was_torn_in_its_last_line_loses_only_that(tmp_path, kept):
    journal = tmp_path / "a.journal"
    study = optuna.create_study(study_name="a", storage=open_storage(str(journal)).optuna)
    for value in range(3):
        study.tell(study.ask(), value)
    whole = journal.read_bytes()
    last_line = whole.splitlines(keepends=True)[-1]
    journal.write_bytes(whole[: -len(last_line)] + last_line[:kept])
    again = optuna.load_study(study_name="a", storage=open_storage(str(journal)).optuna)
    assert [trial.state.name for trial in again.trials] == ["COMPLETE", "COMPLETE", "RUNNING"]
    again.tell(again.ask(), 7.0)
    assert all(json.loads(line) for line in journal.read_text().splitlines())


def test_journal_that_is_torn_while_others_have_it_open_is_mended_by_the_next_to_write(tmp_path):
    journal = tmp_path / "a.journal"
    studies = [
        optuna.create_study(study_name="a", storage=open_storage(str(journal)).optuna, load_if_exists=True)
        for _ in range(2)
    ]
    with journal.open("ab") as file:
        file.write(b'{"op_code": 4, "worker')
    for study in studies:
        study.tell(study.ask(), 1.0)
    assert [len(study.trials) for study in studies] == [2, 2]


@pytest.mark.parametrize(
    ("uri", "line"),
    [
        ("mysql://a@b/c", "study.storage is 'mysql://a@b/c', but it must be a file, sqlite:///FILE or postgres"),
        ("/dev/null/a", "study.storage is '/dev/null/a', but no file can be used there"),
        ("", "but no file can be used there (it is not a regular file)"),
        ("/proc/a", "study.storage is '/proc/a', but no file can be used there"),
        ("sqlite:////proc/a", "study.storage is 'sqlite:////proc/a', but no file can be used there"),
        ("sqlite:////dev/null/a", "study.storage is 'sqlite:////dev/null/a', but no file can be used there"),
    ],
)
def test_storage_that_cannot_be_used_is_refused_in_one_line(uri, line):
    with pytest.raises(StudyError) as error:
        open_storage(uri)
    assert line in str(error.value)
    assert "secret" not in str(error.value)


@pytest.mark.parametrize(
    "contents", ["labels: {}\nsplits: {}\n", "a\nand a last line", "SQLite format 3\0", "garbage\n"]
)
def test_storage_refuses_a_file_that_is_no_journal_and_leaves_it_as_it_is(tmp_path, contents):
    (tmp_path / "a").write_text(contents)
    with pytest.raises(StudyError, match="that file is not an Optuna journal"):
        open_storage(str(tmp_path / "a"))
    assert (tmp_path / "a").read_text() == contents


@pytest.mark.parametrize("table", ["studies", "runs"])
@pytest.mark.parametrize("opens", [open_storage, existing_storage])
def test_storage_refuses_a_database_of_somebody_else_and_leaves_it_as_it_is(tmp_path, opens, table):
    with closing(sqlite3.connect(tmp_path / "a.db")) as connection:
        connection.execute(f"CREATE TABLE {table} (a)")
        connection.commit()
        with pytest.raises(StudyError, match="it holds other tables"):
            opens(f"sqlite:///{tmp_path}/a.db")
        assert connection.execute("SELECT name FROM sqlite_master").fetchall() == [(table,)]


def test_storage_whose_tables_were_being_created_when_it_was_interrupted_is_created_anew(tmp_path, monkeypatch):
    uri = f"sqlite:///{tmp_path}/a.db"

    def begin(file):
        with closing(sqlite3.connect(file)) as connection:
            connection.execute("CREATE TABLE studies (a)")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("armscan.sweeps.storage.storage.create_tables", begin)
        with pytest.raises(KeyboardInterrupt):
            open_storage(uri)
    assert open_storage(uri).study_names == []


def test_storage_that_is_looked_at_is_not_made(storage_uri, tmp_path):
    assert existing_storage(storage_uri) is None
    assert [file for file in tmp_path.iterdir() if file.name.startswith("a.")] == []
    optuna.create_study(study_name="a", storage=open_storage(storage_uri).optuna)
    there = existing_storage(storage_uri)
    assert there is not None
    assert optuna.get_all_study_names(there.optuna) == ["a"]


def test_storage_refuses_what_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "a")
    with pytest.raises(StudyError, match="but no file can be used there"):
        existing_storage(str(tmp_path / "a"))


@pytest.mark.parametrize("opens", [open_storage, existing_storage])
def test_storage_refuses_an_address_with_a_password(opens):
    with pytest.raises(InvalidValueError, match=r"^study.storage has a password in its address") as raised:
        opens("postgresql://me:secret@host/db")
    assert "secret" not in str(raised.value)
