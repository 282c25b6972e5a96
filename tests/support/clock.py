"""A wall clock for a test's processes that can be set while they run; their monotonic clock stays unchanged."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from tests.support.requirements import unavailable

LIBRARIES = Path("/usr/lib")
# Python's own `time.sleep` passes an absolute monotonic time, on which libfaketime fails.
SLEEP = "import select, time\ntime.sleep = lambda seconds: select.select([], [], [], seconds) and None\n"


class WallClock:
    """A wall clock, by libfaketime.

    Args:
        folder: Folder for its files.
    """

    def __init__(self, folder: Path) -> None:
        libraries = sorted(LIBRARIES.glob("*/faketime/libfaketimeMT.so.1"))
        if shutil.which("faketime") is None or not libraries:
            unavailable("libfaketime is not installed: apt-get install faketime")
        folder.mkdir()
        (folder / "sitecustomize.py").write_text(SLEEP)
        self._file = folder / "offset"
        self.set(0)
        # Environment of the processes that have this clock.
        self.environment = os.environ | {
            "LD_PRELOAD": str(libraries[0]),
            "PYTHONPATH": os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]),
            "FAKETIME_TIMESTAMP_FILE": str(self._file),
            "FAKETIME_NO_CACHE": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        }

    def set(self, hours: int) -> None:
        """Set it to this many hours after the real time."""
        written = self._file.with_suffix(".new")
        written.write_text(f"{hours:+d}h\n")
        written.replace(self._file)
