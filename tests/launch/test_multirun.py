"""Multiruns: the overrides that their jobs share, the address of their store, and their end."""

import json
from unittest.mock import Mock

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString

from armscan import run
from armscan.experiment.job import PARENT_FILE
from armscan.launch.multirun import Multirun, _common


@pytest.mark.parametrize("uri", ["sqlite:///mlruns.db", "sqlite:////tmp/it's.db", r"sqlite:////tmp/a\\'b.db"])
def test_address_of_the_store_is_read_again_as_it_was(uri):
    word = f"tracking.uri={QuotedString(uri, Quote.single).with_quotes()}"
    assert OverridesParser.create().parse_override(word).value() == uri


def test_second_interrupt_leaves_the_command_that_resumes_the_grid(tmp_path, monkeypatch, capsys):
    parent = {"run_id": "a" * 32, "tracking": {"uri": "sqlite:///mine.db"}, "trust": False}
    (tmp_path / PARENT_FILE).write_text(json.dumps(parent))
    monkeypatch.setattr(Multirun, "folder", tmp_path)
    monkeypatch.setattr(run, "end_multirun", Mock(side_effect=KeyboardInterrupt))
    run._end_interrupted()
    told = capsys.readouterr().err
    assert told.startswith("the grid was not closed; resume it with: ")
    assert f"resume={'a' * 32} tracking.uri=sqlite:///mine.db" in told


def test_override_of_all_jobs_is_recognised_however_hydra_spells_it():
    words = ["agent.lr=1e-3", "env.transform={rx_deg: 1.0}", "stack_memory=false", "data.path='a b'", "seed=1"]
    words += ["~data.folds", "+x=[1, 2]", "seed=3,4"]
    ((first, second),) = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(words), None)
    common = _common(words)
    assert [[word for word in job if word not in common] for job in (first, second)] == [["seed=3"], ["seed=4"]]
