"""State of the code of a run: its git commit, and what differs from it."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import armscan
from armscan.tracking.tags import COMMIT_TAG, UNKNOWN, VERSION_TAG
from armscan.utils.files import sha256

COMMIT, DIRTY, DIFF_SUM = "git.commit", "git.dirty", "git.diff.sha256"
# What identifies the code of a run.
CODE_TAGS = (VERSION_TAG, COMMIT, DIFF_SUM)
# Largest untracked file that the diff includes: source code, but no volume beside it.
MAX_UNTRACKED_BYTES = 2**20
# Override the user's settings of `git diff`, which could break `git apply`.
PLAIN = ("--no-ext-diff", "--no-textconv", "--no-color", "--binary", "--src-prefix=a/", "--dst-prefix=b/")
TIMEOUT_S = 30.0
COMMIT_CHARS, SOURCE_CHARS = 9, 12


@dataclass(frozen=True)
class CodeState:
    """State of the source code when it was loaded.

    Args:
        commit: Git commit; `unknown` if the code is not in a git repository.
        diff: Uncommitted changes in the format of `git apply`, empty if there are none; None if they are not known.
    """

    commit: str
    diff: bytes | None

    @property
    def tags(self) -> dict[str, str]:
        """Tags that identify the code."""
        known = {} if self.commit == UNKNOWN else {COMMIT_TAG: self.commit}
        dirty = UNKNOWN if self.diff is None else str(bool(self.diff)).lower()
        summed = {DIFF_SUM: sha256(self.diff)} if self.diff else {}
        return {COMMIT: self.commit, **known, DIRTY: dirty, **summed}


@functools.cache
def code_state() -> CodeState:
    """Return the state of the code, read once per process, because loaded code does not change."""
    return code_state_in(Path(__file__).parent)


@functools.cache
def code_version() -> str:
    """Return armscan's commit, or its version outside of git, and a checksum of its source, read once per process."""
    commit, package = code_state().commit, Path(armscan.__file__).parent
    sources = (f"{file.relative_to(package)}\0".encode() + file.read_bytes() for file in sorted(package.rglob("*.py")))
    version = armscan.__version__ if commit == UNKNOWN else commit[:COMMIT_CHARS]
    return f"{version} {sha256(b''.join(sources))[:SOURCE_CHARS]}"


def code_tags() -> dict[str, str]:
    """Return the tags by which a run's code is compared with today's: armscan's version, commit and changes."""
    tags = code_state().tags
    return {VERSION_TAG: armscan.__version__, COMMIT: tags[COMMIT], DIFF_SUM: tags.get(DIFF_SUM, "")}


def code_state_in(folder: Path) -> CodeState:
    """Return the state of the working tree that contains a folder."""
    commit = UNKNOWN
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        # A package installed inside another project's tree is not part of that project's code.
        if _git(folder, "ls-files", "--", "."):
            commit = _git(folder, "rev-parse", "HEAD").decode().strip()
            tree = os.fsdecode(_git(folder, "rev-parse", "--show-toplevel")).rstrip("\n")
            return CodeState(commit, _diff(Path(tree)))
    return CodeState(commit, None)


def _diff(tree: Path) -> bytes:
    """Return the diff of a working tree from its commit, including new files, without changing the index."""
    new = [name for name in _git(tree, "ls-files", "--others", "--exclude-standard", "-z").split(b"\0") if name]
    left_out = {name: why for name in new if (why := _why_left_out(tree, name))}
    told = "".join(f"# not kept, {why}: {os.fsdecode(name)!r}\n" for name, why in left_out.items()).encode()
    kept = [name for name in new if name not in left_out]
    with tempfile.TemporaryDirectory() as beside:
        # A diff shows new files only if the index lists them: list them in a copy of the index.
        index = Path(beside, "index")
        shutil.copyfile(tree / os.fsdecode(_git(tree, "rev-parse", "--git-path", "index")).rstrip("\n"), index)
        if kept:
            words = ("add", "--intent-to-add", "--force", "--pathspec-from-file=-", "--pathspec-file-nul")
            _git(tree, "--literal-pathspecs", *words, index=index, given=b"\0".join(kept))
        return told + _git(tree, "diff", *PLAIN, "HEAD", index=index)


def _why_left_out(tree: Path, name: bytes) -> str | None:
    """Return why the diff cannot include a new file; None if it can."""
    if name.endswith(b"/"):
        return "because it is a repository of its own"
    return "for its size" if (tree / os.fsdecode(name)).lstat().st_size > MAX_UNTRACKED_BYTES else None


def _git(folder: Path, *arguments: str, index: Path | None = None, given: bytes = b"") -> bytes:
    """Run git in a folder, and return its output."""
    # Inside a git hook, these variables point to the hook's repository.
    variables = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    if index is not None:
        variables["GIT_INDEX_FILE"] = str(index)
    return subprocess.run(
        ["git", *arguments], cwd=folder, input=given, capture_output=True, timeout=TIMEOUT_S, check=True, env=variables
    ).stdout
