"""CSV files, as a spreadsheet reads them."""

import csv
import io

import pytest

from armscan.utils.csv_file import safe_cell, write_csv

FORMULAS = ["=1+1", "+1+1", "-1+1", "@SUM(A1)", "-", '=HYPERLINK("http://x")', "\uff1d1+1"]


@pytest.mark.parametrize("name", FORMULAS, ids=repr)
def test_name_that_a_spreadsheet_would_compute_is_a_text_in_cells_and_headings(name):
    file = io.StringIO()
    write_csv(file, ["run", name], [{"run": name, name: 1.5}])
    headings, row = csv.reader(io.StringIO(file.getvalue(), newline=""))
    assert headings == ["run", f"'{name}"]
    assert row == [f"'{name}", "1.5"]


@pytest.mark.parametrize("value", [-1, -1.5, "-1.5", "+2", "-1e-3", "-inf", 0, None, True, "a=b", "", "a-y"], ids=repr)
def test_numbers_and_other_names_stay_as_they_are(value):
    assert safe_cell(value) == value


@pytest.mark.parametrize("control", ["\t", "\r", "\n", "\r\n", "\x1b"], ids=repr)
def test_control_character_begins_no_cell_and_no_line(control):
    file = io.StringIO(newline="")
    write_csv(file, ["a"], [{"a": f"{control}=1+1"}, {"a": f"x{control}=1+1"}])
    rows = file.getvalue().splitlines()
    spelled = control.encode("unicode_escape").decode()
    assert rows == ["a", f"{spelled}=1+1", f"x{spelled}=1+1"]


def test_row_without_a_value_has_an_empty_cell():
    file = io.StringIO()
    write_csv(file, ["a", "b"], [{"b": None}, {"a": 0}])
    assert file.getvalue() == "a,b\n,\n0,\n"
