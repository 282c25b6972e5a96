"""A private Slurm for tests: one node, this machine, on free ports of its loopback."""

from __future__ import annotations

import getpass
import os
import secrets
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.ports import free_ports
from tests.support.processes import end_all, with_variable
from tests.support.waiting import wait_until

PROGRAMS = ("munged", "slurmctld", "slurmd", "srun", "sbatch", "scontrol")
CONF = "SLURM_CONF"
STOP_S = 10.0
CONFIGURATION = """
ClusterName=armscan
SlurmUser={user}
SlurmdUser={user}
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={slurmctld_port}
SlurmdPort={slurmd_port}
# On the loopback only, which {host} is made to be.
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
AuthType=auth/munge
# A requeued job starts only after the credential of its first start has expired; less than this is not allowed.
AuthInfo=socket={folder}/munge.socket,cred_expire=5
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
# Neither cgroups nor accounting.
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
# CPUs as given below, however many there are.
SlurmdParameters=config_overrides
ReturnToService=2
KillWait=15
SchedulerParameters=batch_sched_delay=0,sched_min_interval=0,bf_interval=1,sched_interval=1
NodeName=node NodeHostname={host} NodeAddr=127.0.0.1 CPUs=8
PartitionName=all Nodes=node Default=YES MaxTime=INFINITE State=UP
"""


def missing_program() -> str | None:
    """Return a program of Slurm that is not installed; None if all are."""
    # Debian installs daemons outside a user's path.
    return next((each for each in PROGRAMS if _found(each) is None), None)


@contextmanager
def slurm() -> Iterator[Slurm]:
    """Start a Slurm; stop it at the end of the block."""
    # Short, because the length of socket paths is limited.
    folder = Path(tempfile.mkdtemp(prefix="armscan-slurm-"))
    # Munge wants everybody to reach its socket.
    folder.chmod(0o711)
    started = Slurm(folder)
    try:
        started.start()
        yield started
    finally:
        started.stop()
        shutil.rmtree(folder, ignore_errors=True)


class Slurm:
    """One node that takes eight jobs at once, with any number of cores.

    Args:
        folder: Empty folder for its configuration and everything that it writes.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._conf = folder, folder / "slurm.conf"
        self.environment = {CONF: str(self._conf)}
        self._processes: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        """Start its daemons, and wait until the node takes jobs."""
        folder = self._folder
        key = folder / "munge.key"
        key.write_bytes(secrets.token_bytes(1024))
        key.chmod(0o400)
        for name in ("state", "spool"):
            (folder / name).mkdir()
        ports = dict(zip(("slurmctld_port", "slurmd_port"), free_ports(2), strict=True))
        values = {"folder": folder, "host": socket.gethostname(), "user": getpass.getuser(), **ports}
        self._conf.write_text(CONFIGURATION.format(**values))
        files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "seed-file": "seed", "log-file": "log"}
        words = [f"--{option}={folder}/munge.{name}" for option, name in files.items()]
        self._started("munged", "--foreground", "--num-threads=1", *words)
        self._wait(lambda: (folder / "munge.socket").exists())
        self._started("slurmctld", "-D")
        self._started("slurmd", "-D", "-N", "node")
        self._wait(lambda: "idle" in self.told("sinfo", "--noheader", "--format=%T"))

    def stop(self) -> None:
        """End everything that it has started."""
        if len(self._processes) == len(("munged", "slurmctld", "slurmd")):
            subprocess.run(["scancel", "--user", getpass.getuser()], env=os.environ | self.environment, check=False)
        for process in reversed(self._processes):
            process.terminate()
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes.clear()
        # Job steps outlive the daemons.
        end_all(lambda: with_variable(CONF, str(self._conf)))

    def told(self, *command: str) -> str:
        """Return what a command of Slurm prints."""
        environment = os.environ | self.environment
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout

    def jobs(self) -> dict[str, str]:
        """Return the states of the queued and running jobs, by their IDs."""
        lines = self.told("squeue", "--noheader", "--array", "--format=%i %T").splitlines()
        return dict(line.split() for line in lines)

    def log(self) -> str:
        """Return the logs of its daemons."""
        return "\n".join(file.read_text(errors="replace") for file in sorted(self._folder.glob("*.log")))

    def _started(self, program: str, *words: str) -> None:
        found = _found(program)
        assert found is not None
        with (self._folder / f"{program}.log").open("ab") as log:
            process = subprocess.Popen(
                [found, *words],
                cwd=self._folder,
                env=os.environ | self.environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self._processes.append(process)

    def _wait(self, is_there: Callable[[], bool]) -> None:
        wait_until(is_there, process=self._processes[-1], log=self.log, poll_s=0.1)


def _found(program: str) -> str | None:
    return shutil.which(program, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
