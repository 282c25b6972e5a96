"""Which state of the code a run was made with: its commit, and what was changed since."""

from __future__ import annotations

import functools
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from armscan.files import sum_of

UNKNOWN = "unknown"
# What git says of files that nobody has added is kept up to this size each: code, and not a volume beside it.
MAX_UNTRACKED_BYTES = 2**20
COMMIT, DIRTY, DIFF_SUM = "git.commit", "git.dirty", "git.diff.sha256"


@dataclass(frozen=True)
class Source:
    """The code as it was loaded.

    Args:
        commit: of git, `unknown` where the code is under no git.
        diff: what was changed since, as `git apply` takes it; None where nothing was, or the code is under no git.
    """

    commit: str
    diff: bytes | None

    @property
    def tags(self) -> dict[str, str]:
        """What is tracked of it."""
        if self.commit == UNKNOWN:
            return {COMMIT: UNKNOWN, DIRTY: UNKNOWN}
        tags = {COMMIT: self.commit, "mlflow.source.git.commit": self.commit, DIRTY: str(self.diff is not None).lower()}
        return tags if self.diff is None else tags | {DIFF_SUM: sum_of(self.diff)}


@functools.cache
def source() -> Source:
    """Returns the state of the code, once for a process, whose code stays what it was when it was loaded."""
    return source_in(Path(__file__).parent)


def source_tags() -> Mapping[str, str]:
    """Returns the git commit of the code and whether its tree was dirty; 'unknown' where the code is under no git."""
    return source().tags


def source_in(folder: Path) -> Source:
    """Returns the state of the working tree that a folder is in."""
    commit, top = (_git(folder, "rev-parse", *what) for what in (("HEAD",), ("--show-toplevel",)))
    if commit is None or top is None:
        return Source(UNKNOWN, None)
    tree = Path(top.decode().strip())
    # Whatever a person has configured for their own eyes would be in the way of `git apply`.
    plain = ("--no-ext-diff", "--no-textconv", "--no-color", "--binary", "--src-prefix=a/", "--dst-prefix=b/")
    diff = _git(tree, "diff", *plain, "HEAD") or b""
    for name in (_git(tree, "ls-files", "--others", "--exclude-standard", "-z") or b"").split(b"\0"):
        if name:
            diff += _added(tree, name.decode(errors="surrogateescape"), plain)
    return Source(commit.decode().strip(), diff or None)


def _added(tree: Path, name: str, plain: tuple[str, ...]) -> bytes:
    """Returns the diff of a file that nobody has added to git."""
    file = tree / name
    try:
        size = file.stat().st_size
    except OSError:
        return b""
    if size > MAX_UNTRACKED_BYTES:
        return f"# not kept, with {size} bytes: {name!r}\n".encode()
    # That two files differ is an exit code of 1.
    return _git(tree, "diff", "--no-index", *plain, "--", "/dev/null", name, allowed=(0, 1)) or b""


def _git(folder: Path, *arguments: str, allowed: tuple[int, ...] = (0,)) -> bytes | None:
    try:
        answer = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, timeout=30, check=False)
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout if answer.returncode in allowed else None
