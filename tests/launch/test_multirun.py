"""Overrides that the jobs of a multirun share."""

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser

from armscan.launch.multirun import _common


def test_override_of_all_jobs_is_recognised_however_hydra_spells_it():
    words = ["agent.lr=1e-3", "env.transform={rx_deg: 1.0}", "stack_memory=false", "data.path='a b'", "seed=1"]
    words += ["~data.folds", "+x=[1, 2]", "seed=3,4"]
    ((first, second),) = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(words), None)
    common = _common(words)
    assert [[word for word in job if word not in common] for job in (first, second)] == [["seed=3"], ["seed=4"]]
