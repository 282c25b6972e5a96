"""A private PostgreSQL server for tests and benchmarks, on a free port of this machine."""

from __future__ import annotations

import itertools
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.support.ports import LOOPBACK, free_port
from tests.support.waiting import wait_until

MEMORY, ROOM_BYTES = Path("/dev/shm"), 6 * 2**30
USER, PASSWORD = "armscan", "not-to-be-shown"
DEBIAN, PROGRAMS = Path("/usr/lib/postgresql"), ("initdb", "postgres")


def programs() -> Path | None:
    """Return the folder of PostgreSQL's programs, Debian's newest before those on the path; None if there are none."""
    of_debian = sorted(DEBIAN.glob("*/bin"), key=lambda folder: float(folder.parent.name), reverse=True)
    on_path = [Path(found).parent] if (found := shutil.which("initdb")) else []
    return next((each for each in (*of_debian, *on_path) if all((each / name).exists() for name in PROGRAMS)), None)


@contextmanager
def postgres_server(host: str = LOOPBACK, *, in_memory: bool = False, **settings: str) -> Iterator[PostgresServer]:
    """Start a server with these settings beside PostgreSQL's own; stop it at the end of the block.

    This process and its children read the password from the file that PGPASSFILE names.

    Args:
        host: Address that it listens on.
        in_memory: Whether to keep its data in memory, if there is room: a database has 300 files, and some disks take
            minutes to remove those of a hundred. Default: False, as users do.
        **settings: Settings of PostgreSQL.
    """
    has_room = in_memory and MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > ROOM_BYTES
    folder = Path(tempfile.mkdtemp(prefix="armscan-postgres-", dir=MEMORY if has_room else None))
    before = os.environ.get("PGPASSFILE")
    try:
        server = PostgresServer(folder, settings, host)
        passwords = folder / "pgpass"
        passwords.write_text(f"*:*:*:{USER}:{PASSWORD}\n")
        passwords.chmod(0o600)
        os.environ["PGPASSFILE"] = str(passwords)
        server.start()
        try:
            yield server
        finally:
            server.stop(at_once=True)
    finally:
        os.environ.pop("PGPASSFILE", None)
        if before is not None:
            os.environ["PGPASSFILE"] = before
        shutil.rmtree(folder, ignore_errors=True)


class PostgresServer:
    """A server with one user who has a password.

    Args:
        folder: Empty folder for its data.
        settings: Settings of PostgreSQL, beside those of a private server.
        host: Address that it listens on.
    """

    def __init__(self, folder: Path, settings: Mapping[str, str] | None = None, host: str = LOOPBACK) -> None:
        found = programs()
        assert found is not None
        self._host = host
        self._programs, self._data, self._log = found, folder / "data", folder / "log"
        # It refuses to run as root.
        self._account = _account() if os.geteuid() == 0 else None
        self._process: subprocess.Popen[bytes] | None = None
        self._numbers, self._settings = itertools.count(), dict(settings or {})
        self.port = free_port(host)
        password = folder / "password"
        password.write_text(PASSWORD)
        if self._account is not None:
            for path in (folder, password):
                shutil.chown(path, self._account)
        words = ("-D", self._data, "-U", USER, f"--pwfile={password}", "--auth=scram-sha-256", "--encoding=UTF8")
        assert self._started("initdb", *words, "--no-sync").wait() == 0, self._log.read_text()
        with (self._data / "pg_hba.conf").open("a") as allowed:
            allowed.write("host all all samenet scram-sha-256\n")

    def start(self) -> None:
        """Start it, and wait until it answers."""
        # Without fsync: only the server is killed here, never the machine.
        own = {"port": self.port, "listen_addresses": self._host, "unix_socket_directories": "", "fsync": "off"}
        words = [word for key, value in (self._settings | own).items() for word in ("-c", f"{key}={value}")]
        self._process = self._started("postgres", "-D", self._data, *words)
        wait_until(self._answers, process=self._process, log=self._log.read_text)

    def stop(self, *, at_once: bool = False) -> None:
        """Stop it, with all connections.

        Args:
            at_once: Whether to stop as if the power failed; the next start then recovers.
        """
        if self._process is not None:
            self._process.send_signal(signal.SIGQUIT if at_once else signal.SIGINT)
            self._process.wait()
        self._process = None

    def restart(self, away_s: float = 0.0, *, at_once: bool = False) -> None:
        """Stop it, and start it again after a while."""
        self.stop(at_once=at_once)
        time.sleep(away_s)
        self.start()

    def make_database(self) -> str:
        """Make an empty database, and return its address."""
        name = f"study_{next(self._numbers)}"
        self.execute(f"CREATE DATABASE {name}")
        return self.uri(name)

    def execute(self, statement: str) -> list[tuple[Any, ...]]:
        """Execute a statement in the database `postgres`; return its rows."""
        import psycopg

        with psycopg.connect(self.uri("postgres"), password=PASSWORD, autocommit=True) as connection:
            cursor = connection.execute(statement)
            return cursor.fetchall() if cursor.description else []

    def uri(self, database: str) -> str:
        """Return the address of a database, without the password."""
        return f"postgresql://{USER}@{self._host}:{self.port}/{database}"

    def _answers(self) -> bool:
        import psycopg

        try:
            psycopg.connect(self.uri("postgres"), password=PASSWORD, connect_timeout=5).close()
        except psycopg.OperationalError:
            return False
        return True

    def _started(self, program: str, *words: str | Path) -> subprocess.Popen[bytes]:
        account: dict[str, Any] = {}
        if self._account is not None:
            group = pwd.getpwnam(self._account).pw_gid
            account = {"user": self._account, "group": group, "extra_groups": []}
        with self._log.open("ab") as log:
            # In its own session: a Ctrl-C for the parent process would stop the server, too.
            return subprocess.Popen(
                [self._programs / program, *words], cwd="/", stdout=log, stderr=log, start_new_session=True, **account
            )


def _account() -> str:
    """Return the account that runs the server if this process is root."""
    known = {each.pw_name for each in pwd.getpwall()}
    return "postgres" if "postgres" in known else "nobody"
