"""The state of the code, in real git repositories."""

import subprocess

import pytest

from armscan.files import sum_of
from armscan.tracking.source import MAX_UNTRACKED_BYTES, source_in

NAMES = ["code.py", "blob.bin", "gone.py"]


def git(folder, *arguments):
    identity = ["-c", "user.name=N", "-c", "user.email=n@example.org", "-c", "commit.gpgsign=false"]
    ended = subprocess.run(["git", *identity, *arguments], cwd=folder, capture_output=True, text=True, check=True)
    return ended.stdout.strip()


@pytest.fixture
def repository(tmp_path):
    folder = tmp_path / "repository"
    folder.mkdir()
    git(folder, "init", "--quiet")
    (folder / "inner").mkdir()
    for name in NAMES:
        (folder / name).write_bytes(b"one\ntwo\n" if name.endswith("py") else bytes(range(256)))
    (folder / ".gitignore").write_text("ignored\n")
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message", "first")
    return folder


def contents(folder):
    files = (file for file in folder.rglob("*") if file.is_file() and ".git" not in file.relative_to(folder).parts)
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def test_source_of_a_clean_tree_is_its_commit_alone(repository):
    found = source_in(repository / "inner")
    assert found.diff is None
    commit = git(repository, "rev-parse", "HEAD")
    assert found.tags == {"git.commit": commit, "mlflow.source.git.commit": commit, "git.dirty": "false"}


def test_source_keeps_every_change_so_that_it_can_be_applied_again(repository, tmp_path):
    (repository / "code.py").write_text("one\nthree\n")
    (repository / "blob.bin").write_bytes(bytes(reversed(range(256))))
    (repository / "gone.py").unlink()
    (repository / "inner" / "new file.py").write_text("new\n")
    (repository / "inner" / "new.bin").write_bytes(bytes(range(255)))
    (repository / "staged.py").write_text("staged\n")
    git(repository, "add", "staged.py")
    # What a person has set for their own eyes.
    git(repository, "config", "color.ui", "always")
    git(repository, "config", "diff.noprefix", "true")
    found = source_in(repository / "inner")
    assert found.tags["git.dirty"] == "true"
    assert found.tags["git.diff.sha256"] == sum_of(found.diff)
    clone = tmp_path / "clone"
    git(tmp_path, "clone", "--quiet", str(repository), str(clone))
    (tmp_path / "code.diff").write_bytes(found.diff)
    git(clone, "apply", str(tmp_path / "code.diff"))
    assert contents(clone) == contents(repository)
    # Looking has changed nothing.
    assert "A  staged.py" in git(repository, "status", "--porcelain")


def test_source_names_new_files_that_are_too_large_and_leaves_ignored_ones_out(repository, tmp_path):
    (repository / "volume.nii").write_bytes(b"x" * (MAX_UNTRACKED_BYTES + 1))
    (repository / "ignored").write_text("nothing\n")
    diff = source_in(repository).diff
    assert diff == f"# not kept, with {MAX_UNTRACKED_BYTES + 1} bytes: 'volume.nii'\n".encode()


def test_source_without_git_is_unknown(tmp_path, monkeypatch):
    (tmp_path / "bare").mkdir()
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path))
    assert source_in(tmp_path / "bare").tags == {"git.commit": "unknown", "git.dirty": "unknown"}
    monkeypatch.setenv("PATH", str(tmp_path))
    assert source_in(tmp_path / "bare").diff is None
