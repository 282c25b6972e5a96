"""Studies whose workers are jobs of a real Slurm: killed, told of their end, and requeued."""

import os
import signal

import pytest

from tests.cluster.studies import TRAINING, WAITING, parent_of
from tests.support.requirements import unavailable
from tests.support.slurm import missing_program, slurm

SLURM = ["hydra/launcher=submitit_slurm", "hydra.launcher.mem_gb=null", "study.workers=2"]

ACCOUNTING = r"""#!/bin/sh
echo "JobID|State|NodeList"
scontrol show job --oneliner | sed -nE \
    's/.*ArrayJobId=([0-9]+) ArrayTaskId=([0-9]+) .*JobState=([A-Z]+) .*/\1_\2|\3|node/p'
"""


@pytest.fixture(scope="module")
def cluster():
    if (missing := missing_program()) is not None:
        unavailable(f"Slurm's {missing} is not installed: apt-get install slurmctld slurmd slurm-client munge")
    with slurm() as started:
        yield started


def job_of(cluster, number):
    """Return the job of a worker."""
    (job,) = [job for job in cluster.jobs() if job.endswith(f"_{number}")]
    return job


@pytest.mark.slow
def test_study_outlives_a_killed_worker_and_a_killed_job_that_slurm_says_nothing_of(cluster, start):
    study = start(*WAITING, *SLURM, "study.n_trials=4", "study.final_eval.top_k=0", environment=cluster.environment)
    study.kill_worker(0)
    # submitit's process, the worker's parent: without it, the launcher has no result to wait for.
    above = parent_of(study.holder(1)["pid"])
    os.kill(above, signal.SIGKILL)
    assert study.end() == 0, study.told()
    study.check_complete(4)
    study.check_secret()
    (lost,) = [trial.user_attrs["failure"] for trial in study.trials() if trial.state.name == "FAIL"]
    assert "its worker died" in lost
    # The other worker was still running, and noticed that its parent was gone.
    assert "is requeued" in (study.workers_folder / "worker-1.log").read_text()


@pytest.mark.slow
def test_study_goes_on_when_the_launcher_gives_up_for_one_job_that_was_killed(cluster, start, tmp_path_factory):
    # Accounting needs a database of Slurm's own; this script says what it would say of the jobs.
    programs = tmp_path_factory.mktemp("bin")
    accounting = programs / "sacct"
    accounting.write_text(ACCOUNTING)
    accounting.chmod(0o755)
    environment = cluster.environment | {"PATH": f"{programs}:{os.environ['PATH']}"}
    study = start(*WAITING, *SLURM, "study.n_trials=20", "study.final_eval.top_k=0", environment=environment)
    os.kill(parent_of(study.holder(0)["pid"]), signal.SIGKILL)
    assert study.end() == 0, study.told()
    study.check_complete(20)
    printed = study.printed.read_text()
    assert "hydra/launcher is 'submitit_slurm', which has failed: Job " in printed
    assert "waiting for workers that are still there" in printed


@pytest.mark.slow
def test_jobs_that_are_to_end_hand_their_trials_back_and_go_on_with_them_when_they_are_queued_again(cluster, start):
    words = ["study.n_trials=2", "study.final_eval.top_k=0", "training.env_steps=10000"]
    study = start(*TRAINING, *SLURM, *words, environment=cluster.environment)
    study.holder(0)
    study.holder(1)
    # As Slurm does before a job's time limit, and as an administrator does.
    cluster.told("scancel", "--signal=USR2", job_of(cluster, 0))
    cluster.told("scontrol", "requeue", job_of(cluster, 1))
    assert study.end() == 0, study.told()
    study.check_complete(2)
    assert len(study.trials()) == 2
    for number in (0, 1):
        log = (study.workers_folder / f"worker-{number}.log").read_text()
        assert "is requeued" in log
        assert "is resumed" in log


def test_a_cancelled_job_ends_its_worker_alone_and_an_interrupt_ends_all(cluster, start):
    words = ["study.n_trials=50", "study.final_eval.top_k=0"]
    study = start(*WAITING, *SLURM, *words, environment=cluster.environment)
    study.holder(0)
    cluster.told("scancel", job_of(cluster, 0))
    study.wait(lambda: "is requeued" in (study.workers_folder / "worker-0.log").read_text())
    study.wait(lambda: len(cluster.jobs()) == 1)
    study.holder(1)
    os.kill(study.process.pid, signal.SIGINT)
    assert study.end() == 130, study.told()
    assert study.printed.read_text().endswith("interrupted; the same command resumes the study\n")
    assert {trial.state.name for trial in study.trials()} <= {"COMPLETE", "WAITING"}
    assert {run.info.status for run in study.runs()} <= {"FINISHED", "KILLED"}


def test_study_that_is_started_in_a_job_of_an_array_has_a_job_of_its_own(cluster, start):
    enclosing = {"SLURM_JOB_ID": "76", "SLURM_JOBID": "76", "SLURM_ARRAY_JOB_ID": "76", "SLURM_ARRAY_TASK_ID": "9"}
    words = ["study.workers=1", "study.n_trials=1", "study.final_eval.top_k=0"]
    study = start(*WAITING, *SLURM[:-1], *words, environment=cluster.environment | enclosing)
    assert study.end() == 0, study.told()
    study.check_complete(1)


def test_study_that_slurm_does_not_take_says_why_in_one_line(cluster, start):
    study = start(*WAITING, *SLURM, "hydra.launcher.partition=nowhere", environment=cluster.environment)
    assert study.end() == 2
    last = study.printed.read_text().splitlines()[-1]
    assert last.startswith(
        "error: hydra/launcher is 'submitit_slurm', which has failed: sbatch: error: invalid partition"
    )
