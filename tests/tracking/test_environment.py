"""Records of packages, code and machine of a run."""

import json
import platform
from importlib import metadata

import numpy as np
import torch

from armscan.tracking.environment import REPORTED_PACKAGES, environment, environment_file, environment_tags


def test_environment_has_the_versions_that_are_loaded():
    packages = environment()["packages"]
    assert packages["torch"] == torch.__version__
    assert packages["numpy"] == np.__version__
    assert environment()["python"] == platform.python_version()
    assert json.loads(environment_file()) == environment()


def test_environment_tags_tell_what_figures_may_depend_on():
    tags = environment_tags()
    assert set(tags) == {"version.python", "constraints.sha256", *(f"version.{name}" for name in REPORTED_PACKAGES)}
    assert "not installed" not in tags.values()


def test_packages_in_the_folder_of_another_package_are_left_out(monkeypatch, tmp_path):
    for name, folder in (("alone", "site-packages"), ("within", "site-packages/other/vendored")):
        (tmp_path / folder / f"{name}-1.0.dist-info").mkdir(parents=True)
        (tmp_path / folder / f"{name}-1.0.dist-info" / "METADATA").write_text(f"Name: {name}\nVersion: 1.0\n")
        monkeypatch.syspath_prepend(tmp_path / folder)
    # As in a process that has not cached them.
    packages = environment.__wrapped__()["packages"]
    assert packages["alone"] == "1.0"
    assert "within" not in packages


def test_of_several_versions_on_the_path_the_imported_one_counts(monkeypatch, tmp_path):
    for version in ("1.0", "2.0"):
        (tmp_path / version / f"twice-{version}.dist-info").mkdir(parents=True)
        (tmp_path / version / f"twice-{version}.dist-info" / "METADATA").write_text(
            f"Name: twice\nVersion: {version}\n"
        )
        monkeypatch.syspath_prepend(tmp_path / version)
    assert environment.__wrapped__()["packages"]["twice"] == metadata.version("twice") == "2.0"
