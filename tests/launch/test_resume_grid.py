"""The earlier runs of a repeated grid's jobs."""

import json

import pytest

from armscan.config.compose import compose
from armscan.config.defaults import to_plain
from armscan.errors import ChangedVolumesError, ResumeError, UntrustedError
from armscan.experiment.build import build_setup
from armscan.experiment.job import Grid, Invocation, Job
from armscan.launch.resume_grid import earlier_runs, run_again
from armscan.tracking import TrackedRun
from armscan.tracking.git import COMMIT, code_tags
from armscan.tracking.tags import CONTINUED_TAG, GRID_TAG, OWN_CODE_TAG, PARENT_TAG, STUDY_TAG
from armscan.utils.files import sha256
from armscan.utils.run_files import SHA256_TAGS, VOLUMES_FILE
from tests.support.stores import store_in
from tests.support.tracked_runs import FEW

SUMS = {"config.sha256": "a", "volumes.sha256": "b"}


def job_of(number, grid, *, repeats, folder):
    """Return a job of a grid that repeats another one, whose overrides were stored."""
    grid = Grid(run_id=grid, tracking={}, overrides=[], shared=[], repeats=repeats, is_trusted=False)
    return Job(number, "", "", folder, grid)


def test_earlier_run_is_of_the_repeated_grid_or_one_that_it_continued_or_a_single_run_of_the_same_code(
    tmp_path, database
):
    client, experiment_id = store_in(tmp_path, "armscan")

    def run_with(**tags):
        return client.create_run(experiment_id, name="any", tags=tags).info.run_id

    def run_of(grid, **tags):
        return run_with(**SUMS, **{PARENT_TAG: grid}, **tags)

    repeated, other = (run_with(**{GRID_TAG: json.dumps(["seed=0,1"])}) for _ in range(2))
    middle = run_with(**{CONTINUED_TAG: repeated})
    first = run_with(**{CONTINUED_TAG: middle})
    ours, of_first = run_of(repeated), run_of(first)
    alone = run_with(**SUMS, **code_tags())
    # Of another grid with the same command line, of a study, with other volumes, and of other code.
    run_of(other, **code_tags())
    run_of(run_with(**{STUDY_TAG: "s"}), **{STUDY_TAG: "s"}, **code_tags())
    run_with(**SUMS | {"volumes.sha256": "c"}, **{PARENT_TAG: repeated})
    run_with(**SUMS, **code_tags() | {COMMIT: "0" * 40})
    run_with(**SUMS, **code_tags(), **{OWN_CODE_TAG: "parts:01"})
    job = job_of(0, "2" * 32, repeats=repeated, folder=tmp_path)
    found = [run.info.run_id for run in earlier_runs(client, experiment_id, SUMS, job, {"parts": "02"})]
    assert found == [of_first, ours, alone]


@pytest.mark.parametrize("change", ["new", "changed", "lost", None])
def test_grid_goes_on_with_the_same_volumes_alone(tmp_path, database, change):
    words = [*FEW, f"tracking.uri=sqlite:///{tmp_path}/mlruns.db"]
    config = compose([*words, "seed=1"])
    client, experiment_id = store_in(tmp_path, config.tracking.experiment)
    # Another job of the grid, on the same volumes.
    prints = build_setup(config).split.fingerprints()
    (name,) = prints["test"]
    if change == "new":
        prints["test"] = {}
    elif change == "changed":
        prints["test"][name] = "0" * 64
    record = json.dumps(prints).encode()
    (tmp_path / VOLUMES_FILE).write_bytes(record)
    tags = {PARENT_TAG: "1" * 32, SHA256_TAGS[VOLUMES_FILE]: sha256(record)}
    with TrackedRun.start(
        client, experiment_id, name="0", config=to_plain(compose(words)), tags=tags, folder=tmp_path
    ) as run:
        if change != "lost":
            run.log_files(tmp_path / VOLUMES_FILE)
    job = job_of(1, "2" * 32, repeats="1" * 32, folder=tmp_path)
    begun = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("armscan.launch.resume_grid.run_experiment", lambda *_: begun.append(1))
        if change in ("lost", None):
            run_again(config, Invocation(tmp_path, [], "", {}, job), job)
        else:
            what = f"the grid's volumes are not those that run {run.run_id} of it had: {name} is {change}"
            with pytest.raises(ChangedVolumesError, match=what):
                run_again(config, Invocation(tmp_path, [], "", {}, job), job)
    assert bool(begun) == (change in ("lost", None))


def test_runs_of_the_grid_must_have_the_same_own_code(tmp_path, database, monkeypatch):
    config = compose([*FEW, f"tracking.uri=sqlite:///{tmp_path}/mlruns.db"])
    client, experiment_id = store_in(tmp_path, config.tracking.experiment)
    other = client.create_run(experiment_id, name="n", tags={OWN_CODE_TAG: "parts:01", PARENT_TAG: "1" * 32})
    client.set_terminated(other.info.run_id)
    job = job_of(0, "2" * 32, repeats="1" * 32, folder=tmp_path)
    monkeypatch.setattr("armscan.launch.resume_grid.earlier_runs", lambda *_: [client.get_run(other.info.run_id)])
    with pytest.raises(ResumeError, match="other code of parts"):
        run_again(config, Invocation(tmp_path, [], "", {}, job), job)


def test_job_of_a_stored_command_line_builds_no_class_of_others(tmp_path):
    config = compose(["+agent.agent._target_=joblib.load"])
    job = job_of(3, "0" * 32, repeats="1" * 32, folder=tmp_path)
    with pytest.raises(UntrustedError, match=r"job 3: its configuration builds agent.agent by 'joblib.load'"):
        run_again(config, Invocation(tmp_path, [], "", {}, job), job)
