"""Journals that have lost lines or in which lines were changed: refused, never read as a smaller study."""

import json

import optuna
import pytest
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

from armscan.errors import StudyError
from armscan.sweeps.storage.storage import existing_storage, open_storage


def fill(storage, n_trials=3):
    study = optuna.create_study(study_name="a", storage=storage, load_if_exists=True)
    study.set_user_attr("objectives", ["x"])
    study.enqueue_trial({"x": 0.5})
    for number in range(n_trials):
        trial = study.ask()
        trial.set_user_attr("lease", {"worker": "a", "sum": "0123abcd"})
        trial.report(trial.suggest_float("x", 0, 1), step=0)
        study.tell(trial, number)


def seen_in(file):
    """Return all that a reader sees of the studies in a file."""
    storage = existing_storage(str(file)).optuna
    studies = [(study.study_name, study.user_attrs, study.system_attrs) for study in storage.get_all_studies()]
    return studies, [storage.get_all_trials(study._study_id) for study in storage.get_all_studies()]


@pytest.fixture
def journal(tmp_path):
    """Return the journal of two workers, each of which has read a part of it before the other continued."""
    file = tmp_path / "a.journal"
    first, second = open_storage(str(file)).optuna, open_storage(str(file)).optuna
    for storage in (first, second, first):
        fill(storage)
    return file


def check_refused(file, lines):
    file.write_bytes(b"".join(lines))
    for opens in (open_storage, existing_storage):
        with pytest.raises(StudyError, match=f"study.storage is '{file}', but ") as refused:
            opens(str(file))
        assert "\n" not in str(refused.value)
    return str(refused.value)


def test_journal_without_any_one_line_but_the_last_is_refused(journal):
    lines = journal.read_bytes().splitlines(keepends=True)
    assert len(lines) > 40
    for lost in range(len(lines) - 1):
        said = check_refused(journal, lines[:lost] + lines[lost + 1 :])
    assert said.endswith(
        f"a.journal is damaged: lines at or before line {len(lines) - 1} were lost or changed; put back a copy of the "
        "whole file, or name another one"
    )


def test_journal_without_its_beginning_is_refused(journal):
    lines = journal.read_bytes().splitlines(keepends=True)
    for n_lost in range(1, len(lines)):
        assert "is damaged" in check_refused(journal, lines[n_lost:])


def test_journal_with_a_line_twice_or_two_exchanged_or_one_changed_is_refused(journal):
    lines = journal.read_bytes().splitlines(keepends=True)
    for at in range(len(lines) - 1):
        assert "is damaged" in check_refused(journal, [*lines[:at], lines[at], *lines[at:]])
        if at + 2 < len(lines):
            assert "is damaged" in check_refused(journal, [*lines[:at], lines[at + 1], lines[at], *lines[at + 2 :]])
    changed = next(at for at, line in enumerate(lines) if b'"values":[2' in line)
    check_refused(journal, [*lines[:changed], lines[changed].replace(b"[2", b"[9"), *lines[changed + 1 :]])


def test_journal_without_its_last_lines_is_as_it_was_before_they_were_written(tmp_path):
    file, before = tmp_path / "a.journal", []
    storage = open_storage(str(file)).optuna
    for _ in range(2):
        fill(storage)
        before.append((file.read_bytes(), seen_in(file)))
    for contents, seen in before:
        file.write_bytes(contents)
        assert seen_in(file) == seen
    fill(open_storage(str(file)).optuna)
    assert len(seen_in(file)[1][0]) == 9


def test_journal_that_loses_lines_while_it_is_open_is_refused_to_readers_and_writers(journal):
    storage = open_storage(str(journal)).optuna
    journal.write_bytes(b"".join(journal.read_bytes().splitlines(keepends=True)[:-3]))
    with pytest.raises(StudyError, match=r"a\.journal is damaged"):
        storage.get_all_studies() and storage.get_all_trials(0)
    with pytest.raises(StudyError, match=r"a\.journal is damaged"):
        storage.set_study_user_attr(0, "a", 1)


def test_journal_of_an_earlier_version_is_read_and_what_is_appended_protects_it(tmp_path):
    file = tmp_path / "a.journal"
    fill(JournalStorage(JournalFileBackend(str(file))))
    earlier = file.read_bytes().splitlines(keepends=True)
    # Of lines without a checksum, at least those that create studies and trials cannot be lost unnoticed.
    for at, line in enumerate(earlier):
        if json.loads(line)["op_code"] in (0, 4):
            check_refused(file, earlier[:at] + earlier[at + 1 :])
    for n_lost in range(1, len(earlier)):
        check_refused(file, earlier[n_lost:])
    file.write_bytes(b"".join(earlier))
    fill(open_storage(str(file)).optuna)
    assert [trial.value for trial in seen_in(file)[1][0]] == [0, 1, 2] * 2
    # An earlier version, and Optuna itself, read and write what this one has written, and this one goes on.
    fill(JournalStorage(JournalFileBackend(str(file))))
    fill(open_storage(str(file)).optuna)
    assert [trial.value for trial in seen_in(file)[1][0]] == [0, 1, 2] * 4
    lines = file.read_bytes().splitlines(keepends=True)
    for lost in range(len(lines) - 1):
        check_refused(file, lines[:lost] + lines[lost + 1 :])
