"""The image, as far as it can be judged without an engine."""

import fnmatch
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docker.files import FOLDER, instructions, read_image
from tests.support import REPOSITORY


def test_hadolint_finds_nothing_and_ignores_nothing():
    # Installed with the test extra.
    program = Path(sys.executable).with_name("hadolint")
    words = [program, "--disable-ignore-pragma", "--failure-threshold", "style", FOLDER / "Dockerfile"]
    linted = subprocess.run(words, cwd=FOLDER, capture_output=True, text=True, check=False)
    assert linted.returncode == 0, linted.stdout


def test_image_is_slim_and_pinned_and_does_not_run_as_root():
    bases = {words.split()[0] for name, words in instructions() if name == "FROM"}
    assert bases == {"python:3.11-slim-bookworm"}
    image = read_image()
    # A number: Kubernetes cannot tell whether a name is root.
    user, group = image.words["USER"].split(":")
    assert int(user) > 0 < int(group)
    assert f"--uid {user} " in image.words["RUN"]


def test_image_is_for_cpu_and_pinned_where_nothing_else_is_said():
    assert ("ARG", "TORCH_BUILD=cpu") in instructions()
    (installing,) = (words for name, words in instructions() if name == "RUN" and "sed " in words)
    assert "pip install --no-cache-dir --constraint constraints.txt" in installing


@pytest.mark.parametrize(("build", "pinned"), [("cpu", "+cpu"), ("cu130", "+cu130"), ("", "")])
def test_build_of_torch_is_pinned_too(build, pinned, tmp_path):
    (line,) = (each for each in (REPOSITORY / "constraints.txt").read_text().splitlines() if each.startswith("torch=="))
    (tmp_path / "constraints.txt").write_text(f"tornado==1\n{line}\ntorchvision==2\n")
    (installing,) = (words for name, words in instructions() if name == "RUN" and "sed " in words)
    subprocess.run(["sh", "-euc", installing.partition("&&")[0]], cwd=tmp_path, env={"TORCH_BUILD": build}, check=True)
    assert (tmp_path / "constraints.txt").read_text() == f"tornado==1\n{line}{pinned}\ntorchvision==2\n"


def test_what_is_copied_is_there_and_is_all_that_the_engine_is_sent():
    lines = [line for line in (REPOSITORY / ".dockerignore").read_text().splitlines() if not line.startswith("#")]
    assert lines[0] == "*"
    sent = {line[1:] for line in lines if line.startswith("!")}
    copied = [words.split()[:-1] for name, words in instructions() if name == "COPY" and not words.startswith("--")]
    sources = {source for each in copied for source in each}
    assert [source for source in sources if not (REPOSITORY / source).exists()] == []
    assert {source if source in sent else source.partition("/")[0] for source in sources} == sent
    kept_back = ("docker/secrets/database_password", "docker/.env", ".git", "mlruns.db")
    assert [name for name in kept_back if any(fnmatch.fnmatch(name, each) for each in sent)] == []


def test_entry_can_be_run():
    image = read_image()
    (entry,) = image.entrypoint
    assert image.copied[entry].stat().st_mode & 0o111 == 0o111
    assert all(word in image.copied for word in image.healthcheck if word.startswith("/"))
