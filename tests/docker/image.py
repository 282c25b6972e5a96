"""The image, built and run without a daemon: by buildah in a chroot, from a base that debootstrap makes."""

from __future__ import annotations

import ast
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import psutil

from tests.docker.containers import SECRETS, Containers
from tests.docker.files import FOLDER, instructions
from tests.support import REPOSITORY
from tests.support.requirements import unavailable

PROGRAMS = ("buildah", "debootstrap")
USER_ID = 1000
# Debian's own Python stands in for the official image's, which has the same version.
BASE = """FROM scratch
COPY base /
RUN ln -s /usr/bin/python3 /usr/local/bin/python
"""
IN_A_CHROOT = ("--isolation", "chroot")


class Buildah:
    """Images and containers in their own folder.

    Args:
        folder: Empty folder for all of them.
    """

    def __init__(self, folder: Path) -> None:
        self.words = ["buildah", "--root", str(folder / "images"), "--runroot", str(folder / "run")]
        self.words += ["--storage-driver", "vfs"]

    def __call__(self, *words: object) -> str:
        """Run a command of buildah; return what it prints."""
        ended = subprocess.run([*self.words, *map(str, words)], capture_output=True, text=True, check=False)
        assert ended.returncode == 0, f"{ended.stdout}\n{ended.stderr}"
        return ended.stdout


@contextlib.contextmanager
def built_image() -> Iterator[Buildah]:
    """Build the image `armscan` from the Dockerfile; remove it at the end."""
    if missing := [program for program in PROGRAMS if shutil.which(program) is None]:
        unavailable(f"{' and '.join(missing)} not installed: apt-get install {' '.join(missing)}")
    if os.geteuid() != 0:
        unavailable("an image is built by root")
    # Gigabytes, which pytest would keep.
    with tempfile.TemporaryDirectory(prefix="armscan-image-") as name:
        folder = Path(name)
        buildah = Buildah(folder)
        base = next(words.split()[0] for instruction, words in instructions() if instruction == "FROM")
        release = base.rpartition("-")[2]
        packages = "python3,python3-venv,ca-certificates"
        bootstrap = ["debootstrap", "--variant=minbase", f"--include={packages}", release, str(folder / "base")]
        subprocess.run(bootstrap, check=True, stdout=subprocess.DEVNULL)
        (folder / "Dockerfile").write_text(BASE)
        build = ("build", *IN_A_CHROOT, "--format", "docker", "--pull-never")
        buildah(*build, "--file", folder / "Dockerfile", "--tag", f"docker.io/library/{base}", folder)
        shutil.rmtree(folder / "base")
        sources = pip_sources(folder / "pip.conf")
        buildah(*build, *sources, "--file", FOLDER / "Dockerfile", "--tag", "armscan", REPOSITORY)
        yield buildah


def pip_sources(config: Path) -> list[str]:
    """Return options of a build that let pip find packages where it finds them on this machine.

    Args:
        config: File to write pip's configuration to.
    """
    listed = subprocess.run([sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True)
    pairs = (line.partition("=") for line in listed.stdout.splitlines())
    values = {key.rpartition(".")[2]: ast.literal_eval(value) for key, _, value in pairs}
    config.write_text("\n".join(["[global]", *(f"{key} = {' '.join(each.split())}" for key, each in values.items())]))
    words = {word for value in values.values() for word in value.split()}
    # The files of an index may lie beside its pages.
    named = {str(Path(word.removeprefix("file://")).parent) if word.startswith("file://") else word for word in words}
    paths = sorted(path for path in named if path.startswith("/") and Path(path).exists())
    return [f"--volume={config}:/etc/pip.conf:ro", *(f"--volume={path}:{path}:ro" for path in paths)]


class ImageContainers(Containers):
    """The services in containers of the built image, as its user; they share this machine's network.

    Args:
        buildah: Buildah that has built the image.
        *args: Arguments of `Containers`.
        **given: Values of the compose file's variables.
    """

    def __init__(self, buildah, *args, **given):
        super().__init__(*args, **given)
        self._buildah, self._names = buildah, {}

    def _paths(self) -> dict[str, str]:
        for name in self.services:
            for here, _, _ in self.volumes(name):
                os.chown(here, USER_ID, USER_ID)
        return {}

    def environment(self, name: str) -> dict[str, str]:
        """Return the variables that a service has beside those of the image."""
        return {key: self.here(value) for key, value in self.services[name].get("environment", {}).items()}

    def _command(self, name: str, words: Sequence[str]) -> list[str]:
        if name not in self._names:
            self._names[name] = self._buildah("from", "--pull-never", "armscan").strip()
        mounted = [(self.secret, f"{SECRETS}/{self.secret.name}", ["ro"]), *self.volumes(name)]
        volumes = [f"--volume={':'.join([str(here), target, *options])}" for here, target, options in mounted]
        variables = [f"--env={key}={value}" for key, value in self.environment(name).items()]
        run = [*self._buildah.words, "run", *IN_A_CHROOT, *variables, *volumes, self._names[name], "--"]
        return [*run, *map(self.here, words)]

    def _surroundings(self, name, log):
        return {"stdin": subprocess.DEVNULL, "stdout": log, "stderr": log}

    def _terminate(self, process: subprocess.Popen[bytes]) -> None:
        # An engine signals the container's first process; buildah passes no signal on to it.
        if process.poll() is None:
            first_process(process.pid).send_signal(signal.SIGTERM)


def first_process(pid: int) -> psutil.Process:
    """Return the first process in the container of a `buildah run`."""
    below = psutil.Process(pid).children(recursive=True)
    return next(each for each in below if each.uids().real == USER_ID and "buildah" not in each.cmdline()[0])
