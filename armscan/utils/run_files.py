"""The files in the folder of a run, and the lock of the folder."""

from __future__ import annotations

import contextlib
import fnmatch
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from filelock import FileLock, Timeout

from armscan.errors import FolderInUseError, FolderTakenError
from armscan.utils.files import sha256

# The checkpoints of a training, and what its run was started with.
BEST_CHECKPOINT, LAST_CHECKPOINT = "best.pt", "last.pt"
CONFIG_FILE, VOLUMES_FILE = "config.yaml", "volumes.json"
# The diff of the code from its commit, and the versions of what it was run with.
DIFF_FILE, ENVIRONMENT_FILE = "code.diff", "environment.json"
# The diff of a run that was resumed with other code, by the number of times that it had been resumed.
RESUMED_DIFF_FILE = "resumed_{0}_" + DIFF_FILE
# The final evaluation; in the folder of a trial's training, its run.
EVALUATION_FILE, RUN_FILE = "evaluation.json", "run.json"
# The baselines' episodes, and the page with the results of both.
BASELINES_FILE, RESULTS_PAGE = "baselines.json", "results.html"
LEARNING_CURVE_FILE, VIDEO_FILE = "learning_curve.png", "episode.gif"
# Whether a run gave the same results as the one that it repeats.
REPRODUCTION_FILE = "reproduction.json"
# Length of a shortened run ID.
ID_CHARS = 8
RECORDS = (RUN_FILE, REPRODUCTION_FILE)
POLICY_FOLDER = "policy"
# All that a run writes into its folder, apart from Hydra and the outbox: before it is tracked, and after.
STARTED_WITH = (CONFIG_FILE, VOLUMES_FILE, ENVIRONMENT_FILE, DIFF_FILE)
RESULTS = (
    *(BEST_CHECKPOINT, LAST_CHECKPOINT, EVALUATION_FILE, BASELINES_FILE, RESULTS_PAGE),
    *(LEARNING_CURVE_FILE, VIDEO_FILE),
)
# Tags of a run with the SHA-256 of what it was started with.
SHA256_TAGS = {CONFIG_FILE: "config.sha256", VOLUMES_FILE: "volumes.sha256"}
# Tags of a run with the SHA-256 of its results.
RESULT_SHA256_TAGS = {EVALUATION_FILE: "evaluation.sha256", BASELINES_FILE: "baselines.sha256"}
LOCK_FILE = ".lock"
# The folder of a run's outbox, in the run's folder.
OUTBOX_FOLDER = "tracking"
# Of the files of a run's outbox, named after the run: the uploaded position, the lock, and the entries.
OUTBOX_SUFFIXES = (".delivered.json", ".lock", ".jsonl")
RUN_ID_PATTERN = "[0-9a-f]" * 32


def is_as_tagged(name: str, contents: bytes, tags: Mapping[str, str]) -> bool:
    """Return whether a run's file has the checksum in the run's tags, if they have one."""
    tag = {**SHA256_TAGS, **RESULT_SHA256_TAGS}.get(name, "")
    return tag not in tags or tags[tag] == sha256(contents)


def is_made_by_run(name: str) -> bool:
    """Return whether a file of this name, relative to the folder of a run, is one that runs write."""
    return (
        name in (*STARTED_WITH, *RESULTS, *RECORDS)
        or fnmatch.fnmatchcase(name, RESUMED_DIFF_FILE.format("*"))
        or name.startswith(f"{POLICY_FOLDER}/")
    )


def check_free(folder: Path) -> None:
    """Raise `FolderTakenError` if a folder has a file named like a run's, but not made by a run."""
    # An earlier run that was never tracked has left its start files, the first three of which come together.
    outboxes = (folder / OUTBOX_FOLDER).glob(RUN_ID_PATTERN + OUTBOX_SUFFIXES[-1])
    if any(outboxes) or all((folder / name).is_file() for name in STARTED_WITH[:3]):
        return
    # Broken links count, too.
    if taken := [name for name in (*RESULTS, *STARTED_WITH, POLICY_FOLDER) if os.path.lexists(folder / name)]:
        raise FolderTakenError(
            f"{folder}: holds {taken[0]}, which no run made and this run would overwrite: "
            "name another folder with hydra.run.dir or hydra.sweep.dir"
        )


@contextlib.contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Lock the folder of a run inside the context; raise `FolderInUseError` if another process holds the lock."""
    try:
        with FileLock(folder / LOCK_FILE, timeout=0):
            yield
    except Timeout as error:
        raise FolderInUseError(
            f"{folder}: another process is using this folder; wait until it ends, or stop it"
        ) from error
