"""Records of packages, code and machine of a run."""

import json
import platform

import numpy as np
import torch

from armscan.tracking.environment import TOLD, environment, environment_file, environment_tags


def test_environment_has_the_versions_that_are_loaded():
    packages = environment()["packages"]
    assert packages["torch"] == torch.__version__
    assert packages["numpy"] == np.__version__
    assert environment()["python"] == platform.python_version()
    assert json.loads(environment_file()) == environment()


def test_environment_tags_tell_what_figures_may_depend_on():
    tags = environment_tags()
    assert set(tags) == {"version.python", "constraints.sha256", *(f"version.{name}" for name in TOLD)}
    assert "not installed" not in tags.values()
