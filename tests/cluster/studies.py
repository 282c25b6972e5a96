"""Studies as a user starts them, in PostgreSQL and on an MLflow server, and checks of their outcome."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
from mlflow import MlflowClient
from mlflow.entities import Run
from optuna.trial import FrozenTrial, TrialState

from armscan.config.credentials import STORAGE_PASSWORD
from armscan.sweeps.storage.attribute_names import LEASE, RETRY_OF
from armscan.sweeps.storage.storage import open_storage
from tests.support import FEW_VOLUMES, REPOSITORY
from tests.support.postgres import PASSWORD
from tests.support.processes import start_run
from tests.support.waiting import HANG_S, wait_until

# The user's own files, in the working folder of the command: a worker that does not find them fails every trial.
OWN_FILES = {
    "sweeps/own.yaml": "# @package _global_\ndefaults: [sac_y, _self_]\nstudy: {max_retries: 3}\n",
    "conf/network/own.yaml": "defaults: [auto, _self_]\nvector: {hidden_sizes: [16]}\n",
}
OWN = ["sweep=own", "network=own"]
# Trials that only wait, each one to five seconds.
WAITING = [
    *(
        *OWN,
        "study.task._target_=benchmarks.sweeps.sleeping.Sleeping",
        "study/pruner=none",
    ),
    *("+study.space={training.env_steps:{low:100,high:200},agent.lr:{low:1.0e-4,high:1.0e-2}}", *FEW_VOLUMES),
]
# Trials that train, in epochs of a second or less.
TRAINING = [
    *(*OWN, "study/pruner=none", "training.eval_every_env_steps=200", *FEW_VOLUMES),
    *(
        "training.validation_episodes=2",
        "evaluation.episodes=3",
        "study.final_eval.episodes=3",
        "env.max_steps=8",
        "agent.learning_starts=100",
        "tracking.policy=false",
    ),
    "agent.batch_size=32",
]


class StartedStudy:
    """A running study.

    Args:
        folder: Empty folder that it is started in.
        words: Words of its command line, without its storage and store.
        storage: Address of an empty database.
        tracking: Address of the tracking server.
        environment: Environment variables of the command, beside those of this process.
    """

    def __init__(
        self, folder: Path, words: Sequence[str], storage: str, tracking: str, environment: Mapping[str, str]
    ) -> None:
        self.folder, self._storage = folder, open_storage(storage).optuna
        self._client, self._experiment = MlflowClient(tracking), folder.name
        own = {"PYTHONPATH": str(REPOSITORY), "MLFLOW_TRACKING_URI": tracking, STORAGE_PASSWORD: PASSWORD}
        kept = [f"study.storage={storage}", f"tracking.experiment={self._experiment}"]
        for name, text in OWN_FILES.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
        self.printed = folder / "printed"
        self.process = start_run("-m", *words, *kept, cwd=folder, environment={**own, **environment})

    @property
    def workers_folder(self) -> Path:
        """Folder of the logs of its workers."""
        (folder,) = (self.folder / "studies" / "sac_y" / "workers").iterdir()
        return folder

    def trials(self, name: str = "sac_y") -> list[FrozenTrial]:
        """Return its trials; none if it has not been created yet."""
        if name not in optuna.get_all_study_names(self._storage):
            return []
        return optuna.load_study(study_name=name, storage=self._storage).trials

    def holder(self, number: int) -> dict[str, Any]:
        """Wait until a worker is in the middle of a trial; return its lease."""
        found: list[dict[str, Any]] = []

        def is_there() -> bool:
            running = [trial for trial in self.trials() if trial.state == TrialState.RUNNING]
            leases = [trial.user_attrs.get(LEASE, {}) for trial in running if len(trial.intermediate_values) > 1]
            found.extend(lease for lease in leases if lease.get("worker", "").endswith(f"/{number}"))
            return bool(found)

        self.wait(is_there)
        return found[0]

    def kill_worker(self, number: int) -> None:
        """Kill a worker in the middle of a trial."""
        os.kill(self.holder(number)["pid"], signal.SIGKILL)

    def wait(self, is_there: Callable[[], bool]) -> None:
        """Wait until a condition is true while the study runs."""
        wait_until(is_there, process=self.process, log=self.told, poll_s=0.1)

    def end(self) -> int:
        """Wait for its end; return the exit code."""
        try:
            return self.process.wait(HANG_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(self.told()) from None

    def kill(self) -> None:
        """Kill the command, if it is still there; its workers leave then."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def told(self) -> str:
        """Return the output of the command and its workers."""
        logs = sorted(self.folder.glob("studies/*/workers/*/worker-*.log"))
        logs += sorted(self.folder.glob("studies/*/workers/*/.submitit/*/*.*[rt]"))
        return "\n".join(f"--- {file.name}\n{file.read_text(errors='replace')}" for file in [self.printed, *logs])

    def runs(self) -> list[Run]:
        """Return its runs of the tracking server."""
        experiment = self._client.get_experiment_by_name(self._experiment)
        return list(self._client.search_runs([experiment.experiment_id], max_results=1000))

    def check_complete(self, n_trials: int) -> None:
        """Check that exactly this many trials are complete, and that each trial is tracked once and whole."""
        trials, runs = self.trials(), self.runs()
        finished = [trial for trial in trials if trial.state == TrialState.COMPLETE]
        assert len(finished) == n_trials, self.told()
        assert {trial.state for trial in trials} <= {TrialState.COMPLETE, TrialState.FAIL}
        retried = Counter(trial.user_attrs.get(RETRY_OF) for trial in trials)
        assert all(retried[trial.number] == 1 for trial in trials if trial.state == TrialState.FAIL)
        statuses = Counter((run.info.run_name, run.info.status) for run in runs)
        assert {status for _, status in statuses} <= {"FINISHED", "FAILED"}, f"{statuses}\n{self.told()}"
        (of_study,) = [run for run in runs if run.info.run_name == "study sac_y"]
        children = [run for run in runs if run.data.tags.get("mlflow.parentRunId") == of_study.info.run_id]
        children = [run for run in children if run.data.tags["study"] == "sac_y"]
        assert len(children) == len(trials)
        for trial in trials:
            (run,) = [run for run in children if run.data.tags["trial"] == str(trial.number)]
            assert run.info.run_id == trial.user_attrs["mlflow_run"]
            assert (run.info.status == "FINISHED") == (trial.state == TrialState.COMPLETE)
            if trial.state == TrialState.COMPLETE:
                assert run.data.metrics["mean_steps"] == trial.value
                assert float(run.data.params["agent.lr"]) == trial.params["agent.lr"]

    def check_secret(self) -> None:
        """Check that the password of the storage is in no file, and in no command line of a process."""
        words = [file for file in Path("/proc").glob("[0-9]*/cmdline") if PASSWORD.encode() in _contents(file)]
        assert words == []
        files = [file for file in self.folder.rglob("*") if file.is_file()]
        assert [file for file in files if PASSWORD.encode() in file.read_bytes()] == []

    def worker(self, number: int) -> dict[str, Any]:
        """Return the contents of a worker's file."""
        return json.loads((self.workers_folder / f"worker-{number}.json").read_text())


def parent_of(pid: int) -> int:
    """Return the ID of a process's parent."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def _contents(file: Path) -> bytes:
    try:
        return file.read_bytes()
    # A process that has ended.
    except OSError:
        return b""
