"""Checksums of the code of own classes."""

import importlib
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from armscan.config import own_code as own_code_module
from armscan.config.own_code import as_tag, changed_modules, mixed_modules, own_code

CONFIG = {"obs": {"_target_": "mine.parts.Nerve"}, "agent": {"_target_": "armscan.agents.SAC"}}


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Write the package of an own class, which is imported anew in each test."""
    monkeypatch.syspath_prepend(str(tmp_path))
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "scales.py").write_text("SCALE = 100\n")
    (folder / "late.py").write_text("LATE = 1\n")
    (folder / "parts.py").write_text(
        "import numpy as np\nfrom .scales import SCALE\n\n\nclass Nerve:\n"
        "    def observe(self):\n        from mine.late import LATE\n        return SCALE * LATE\n"
    )
    yield folder
    _forget()


def _forget() -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "mine"]:
        del sys.modules[name]


def test_own_modules_and_those_that_they_import_have_a_checksum(package: Path) -> None:
    assert [*own_code(CONFIG)] == ["mine", "mine.parts", "mine.scales"]


@pytest.mark.parametrize("name", ["parts", "scales"])
def test_only_the_checksum_of_a_changed_module_changes(package: Path, name: str) -> None:
    before = own_code(CONFIG)
    _forget()
    with (package / f"{name}.py").open("a") as file:
        file.write("OTHER = 1\n")
    assert changed_modules(as_tag(before), own_code(CONFIG)) == [f"mine.{name}"]


def test_loaded_code_keeps_its_checksum(package: Path) -> None:
    before = own_code(CONFIG)
    (package / "parts.py").write_text("")
    assert own_code(CONFIG) == before


def test_code_whose_file_is_gone_has_none(package: Path) -> None:
    assert own_code(CONFIG)
    _forget()
    own_code({}, ["mine.parts.Nerve"])
    (package / "parts.py").unlink()
    assert "mine.parts" not in own_code(CONFIG)


def test_armscans_own_and_installed_classes_have_none() -> None:
    assert own_code({"a": {"_target_": "armscan.agents.SAC"}, "b": {"_target_": "torch.nn.Tanh"}}) == {}


def test_further_classes_count_too(package: Path) -> None:
    assert "mine.parts" in own_code({}, ["mine.parts.Nerve"])


def test_what_cannot_be_imported_is_left_out() -> None:
    assert own_code({"obs": {"_target_": "nowhere.parts.Nerve"}}) == {}


def test_nothing_is_known_of_runs_without_checksums(package: Path) -> None:
    assert changed_modules(None, own_code(CONFIG)) == []


def test_modules_of_which_runs_loaded_different_versions_are_named() -> None:
    # Runs of a grid may differ in which classes they have.
    assert mixed_modules(["mine:01 other:02", None, "mine:01 third:03"]) == []
    assert mixed_modules(["mine:01 other:02", "mine:02 other:02", "mine:01"]) == ["mine"]


@pytest.mark.parametrize(
    "text",
    [
        "try:\n    from .nowhere import X\nexcept ImportError:\n    X = 1\n\n\nclass Own:\n    pass\n",
        "from typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    import mine.late\n\n\nclass Own:\n    pass\n",
    ],
    ids=["import that fails", "import for types"],
)
def test_only_what_a_module_loads_counts(
    tmp_path: Path, package: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    importlib.import_module("mine.late")
    (tmp_path / "own_alone.py").write_text(text)
    monkeypatch.delitem(sys.modules, "own_alone", raising=False)
    assert [*own_code({"obs": {"_target_": "own_alone.Own"}})] == ["own_alone"]
    del sys.modules["own_alone"]


def test_code_in_an_archive_has_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(tmp_path / "own.zip", "w") as archive:
        archive.writestr("own_in_zip.py", "class Own:\n    pass\n")
    monkeypatch.syspath_prepend(str(tmp_path / "own.zip"))
    assert own_code({"obs": {"_target_": "own_in_zip.Own"}}) == {}


def test_many_modules_have_one_checksum(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_code_module, "MAX_CHARS", 20)
    before = own_code(CONFIG)
    assert len(before) == 1
    assert changed_modules(as_tag(before), own_code(CONFIG)) == []
