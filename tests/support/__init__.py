"""Helpers for the tests of several packages."""

from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
FEW_VOLUMES = ("data.n_training=1", "data.n_validation=1", "data.n_test=1")
