"""The state of the code, in real git repositories."""

import subprocess
from pathlib import Path

import pytest

from armscan.tracking.git import MAX_UNTRACKED_BYTES, code_state_in
from armscan.utils.files import sha256

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
    (folder / "inner" / "code.py").write_text("inner\n")
    for name in NAMES:
        (folder / name).write_bytes(b"one\ntwo\n" if name.endswith("py") else bytes(range(256)))
    (folder / ".gitignore").write_text("ignored\n")
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message", "first")
    return folder


def contents(folder):
    files = (file for file in folder.rglob("*") if file.is_file() and ".git" not in file.relative_to(folder).parts)
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def clone_with(diff, repository, folder):
    """Return a clone of the repository to which a diff was applied."""
    clone = folder / "clone"
    git(folder, "clone", "--quiet", str(repository), str(clone))
    (folder / "code.diff").write_bytes(diff)
    git(clone, "apply", str(folder / "code.diff"))
    return clone


def test_source_of_a_clean_tree_is_its_commit_alone(repository):
    found = code_state_in(repository / "inner")
    assert found.diff == b""
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
    # A user's own display settings.
    git(repository, "config", "color.ui", "always")
    git(repository, "config", "diff.noprefix", "true")
    found = code_state_in(repository / "inner")
    assert found.tags["git.dirty"] == "true"
    assert found.tags["git.diff.sha256"] == sha256(found.diff)
    assert contents(clone_with(found.diff, repository, tmp_path)) == contents(repository)
    # Looking has changed nothing.
    assert "A  staged.py" in git(repository, "status", "--porcelain")


def test_source_names_new_files_that_are_too_large_and_leaves_ignored_ones_out(repository, tmp_path):
    (repository / "volume.nii").write_bytes(b"x" * (MAX_UNTRACKED_BYTES + 1))
    (repository / "ignored").write_text("nothing\n")
    assert code_state_in(repository).diff == b"# not kept, for its size: 'volume.nii'\n"


def test_source_names_a_repository_inside_the_tree_and_keeps_the_rest(repository):
    (repository / "theirs").mkdir()
    (repository / "theirs" / "a.py").write_text("a = 1\n")
    for words in (["init", "--quiet"], ["add", "a.py"], ["commit", "--quiet", "--message", "first"]):
        git(repository / "theirs", *words)
    (repository / "new.py").write_text("b = 2\n")
    diff = code_state_in(repository).diff
    assert diff.startswith(b"# not kept, because it is a repository of its own: 'theirs/'\n")
    assert b"+b = 2" in diff
    assert b"Subproject" not in diff


def test_source_keeps_new_files_of_odd_names_and_links(repository, tmp_path):
    for name in ("-", "a b", "*", ":(top)x", "\n", "ü"):
        (repository / name).write_text("new\n")
    (repository / "broken").symlink_to("nowhere")
    (repository / "to_folder").symlink_to("inner")
    found = code_state_in(repository)
    clone = clone_with(found.diff, repository, tmp_path)
    assert contents(clone) == contents(repository)
    assert [(clone / name).readlink() for name in ("broken", "to_folder")] == [Path("nowhere"), Path("inner")]


@pytest.mark.parametrize("damaged", ["index", "objects"])
def test_source_that_git_cannot_compare_is_not_taken_for_clean(repository, damaged):
    commit = git(repository, "rev-parse", "HEAD")
    if damaged == "index":
        (repository / ".git" / "index").write_bytes(b"nonsense")
        assert code_state_in(repository).tags["git.dirty"] == "unknown"
        return
    tree = git(repository, "rev-parse", "HEAD^{tree}")
    (repository / ".git" / "objects" / tree[:2] / tree[2:]).unlink()
    assert code_state_in(repository).tags == {
        "git.commit": commit,
        "mlflow.source.git.commit": commit,
        "git.dirty": "unknown",
    }


def test_source_is_that_of_its_own_repository_despite_the_environment(repository, tmp_path, monkeypatch):
    (other := tmp_path / "other").mkdir()
    git(other, "init", "--quiet")
    commit = git(repository, "rev-parse", "HEAD")
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    assert code_state_in(repository).commit == commit


def test_source_without_git_is_unknown(repository, tmp_path, monkeypatch):
    (tmp_path / "bare").mkdir()
    unknown = {"git.commit": "unknown", "git.dirty": "unknown"}
    assert code_state_in(tmp_path / "bare").tags == unknown
    # A package that lies in the tree of another project, which does not track it.
    (installed := repository / ".venv" / "armscan").mkdir(parents=True)
    (installed / "code.py").write_text("installed\n")
    assert code_state_in(installed).tags == unknown
    monkeypatch.setenv("PATH", str(tmp_path))
    assert code_state_in(repository).tags == unknown
