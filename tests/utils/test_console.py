"""Tables in a terminal of 80 columns and in a log."""

import pytest
from rich.table import Column

from armscan.errors import print_error
from armscan.utils.console import print_table, wide_console

COLUMNS = [Column("size", justify="right"), Column("what")]
LONG = "05001_labels_of_a_wrist_whose_name_takes_nearly_all_of_the_terminal.nii.gz"


@pytest.mark.parametrize("width", ["80", "60"])
def test_name_that_does_not_fit_beside_its_row_stands_above_it(capsys, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", width)
    print_table("name", ["[bold]short", LONG], COLUMNS, [["1", "a"], ["22", "b"]])
    printed = capsys.readouterr().out.splitlines()
    assert [line.rstrip() for line in printed] == ["size what", "[bold]short", "   1 a", LONG, "  22 b"]


def test_names_that_fit_stand_beside_their_rows(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    print_table("name", ["short", "other"], COLUMNS, [["1", "a"], ["22", "b"]])
    printed = capsys.readouterr().out.splitlines()
    assert [line.split() for line in printed] == [["name", "size", "what"], ["short", "1", "a"], ["other", "22", "b"]]


def test_log_takes_all_in_one_line(capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    print_table("name", [LONG * 3], COLUMNS, [["1", "a"]])
    assert capsys.readouterr().out.splitlines()[1].split() == [LONG * 3, "1", "a"]
    assert wide_console().width == 160


@pytest.mark.parametrize(("is_terminal", "n_lines"), [(True, 2), (False, 1)])
def test_error_breaks_between_words_on_a_terminal_and_nowhere_in_a_log(capsys, monkeypatch, is_terminal, n_lines):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("sys.stderr.isatty", lambda: is_terminal, raising=False)
    print_error(f"{LONG}, but it must be one of those")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == n_lines + is_terminal
    assert " ".join(lines) == f"error: {LONG}, but it must be one of those"
