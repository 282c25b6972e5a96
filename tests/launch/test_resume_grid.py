"""The earlier runs of a repeated grid's jobs."""

import json

import pytest

from armscan.config.compose import compose
from armscan.errors import UntrustedError
from armscan.experiment.job import Invocation, Job
from armscan.launch.resume_grid import earlier_runs, run_again
from armscan.tracking.tags import GRID_TAG, PARENT_TAG, STUDY_TAG
from tests.support.stores import store_in

SUMS = {"config.sha256": "a", "volumes.sha256": "b"}


def test_earlier_run_is_of_the_repeated_grid_and_never_of_a_study_or_another_grid(tmp_path, database):
    client, experiment_id = store_in(tmp_path, "armscan")

    def run_with(**tags):
        return client.create_run(experiment_id, name="any", tags=tags).info.run_id

    def grid(*words):
        return run_with(**{GRID_TAG: json.dumps(words)})

    uri = "tracking.uri='x'"
    repeated, before, now = (
        grid("seed=0,1", "a=1", uri),
        grid("seed=0,1", uri, "a=1", uri),
        grid("seed=0,1", uri, "a=1"),
    )
    ours = run_with(**SUMS, **{PARENT_TAG: repeated})
    alone = run_with(**SUMS)
    of_repetition = run_with(**SUMS, **{PARENT_TAG: before})
    run_with(**SUMS, **{PARENT_TAG: grid("seed=1,2", uri)})
    run_with(**SUMS, **{PARENT_TAG: run_with(**{STUDY_TAG: "s"}), STUDY_TAG: "s"})
    run_with(**SUMS | {"volumes.sha256": "c"}, **{PARENT_TAG: repeated})
    job = Job(0, "", "", now, tmp_path, repeats=repeated, is_trusted=False)
    found = [run.info.run_id for run in earlier_runs(client, experiment_id, SUMS, job)]
    assert found[0] == ours
    assert {*found} == {ours, alone, of_repetition}


def test_job_of_a_stored_command_line_builds_no_class_of_others(tmp_path):
    config = compose(["+agent.agent._target_=joblib.load"])
    job = Job(3, "", "", "0" * 32, tmp_path, repeats="1" * 32, is_trusted=False)
    with pytest.raises(UntrustedError, match=r"job 3: its configuration builds agent.agent by 'joblib.load'"):
        run_again(config, Invocation(tmp_path, [], "", {}, job), job)
