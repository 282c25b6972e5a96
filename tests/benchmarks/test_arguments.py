"""Arguments of the scripts in `benchmarks`."""

import argparse
import runpy
import sys
from pathlib import Path

import pytest

from benchmarks.arguments import add_options_of, call, given_volumes, parser_of


def measure(folder: Path, *, seeds: tuple[int, ...] = (0, 1), every_s: float = 2.0, storage: str = "journal") -> None:
    """Keep what it was called with."""
    (folder / "called").write_text(f"{seeds} {every_s} {storage}")


def parsed(*arguments: str) -> argparse.Namespace:
    """Return the parsed arguments of a script that calls `measure`."""
    parser = parser_of("Measure.")
    add_options_of(parser, measure)
    return parser.parse_args(arguments)


def test_options_are_the_keyword_arguments_of_a_function(tmp_path: Path) -> None:
    call(measure, parsed("--folder", str(tmp_path / "new"), "--seeds", "3", "5", "--every-s", "1"))
    assert (tmp_path / "new" / "called").read_text() == "[3, 5] 1.0 journal"


def test_without_options_a_function_has_its_own_defaults(tmp_path: Path) -> None:
    call(measure, parsed("--folder", str(tmp_path)))
    assert (tmp_path / "called").read_text() == "(0, 1) 2.0 journal"


@pytest.mark.parametrize("arguments", [["--seeds", "x"], ["--seed"], ["extra"], ["--trials", "3"]])
def test_a_wrong_option_ends_in_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parsed(*arguments)
    assert "error: " in capsys.readouterr().err.splitlines()[-1]


def test_a_folder_without_volumes_ends_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["script", str(tmp_path)])
    with pytest.raises(SystemExit):
        given_volumes("Measure.")
    assert str(tmp_path) in capsys.readouterr().err


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        ("learning.results", ["none"]),
        ("learning.published", ["none"]),
        ("learning.distance", []),
        ("learning.profiles", ["FOLDER", "--phantoms", "0"]),
        ("sweeps", ["compare", "--trails", "3"]),
        ("sweeps", ["same-budget", "--first", "99", "--replicates", "2"]),
        ("sweeps.bench", ["collect", "unknown"]),
        ("sweeps.bench", ["warm-start", "sac_y", "sac_zy", "--studies", "0"]),
        ("sweeps.bench", ["report", "sac_y", "--picture", "no/folder/picture.png"]),
        ("learning.nearness", ["abc", "--tracking", "sqlite:///no/folder/mlruns.db"]),
        ("learning.distance", ["no/folder"]),
    ],
)
def test_a_wrong_argument_of_a_script_ends_in_one_line(
    module: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["script", *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(f"benchmarks.{module}", run_name="__main__")
    assert ended.value.code == 2
    assert "error: " in capsys.readouterr().err.splitlines()[-1]
