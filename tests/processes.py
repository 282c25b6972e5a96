"""What runs on this machine, for tests of what must not be left running."""

from __future__ import annotations

import subprocess
from pathlib import Path


def processes_in(folder: Path) -> list[int]:
    """The processes whose working folder this is."""
    listing = subprocess.run(["ps", "-eo", "pid="], capture_output=True, text=True, check=True).stdout.split()
    found = []
    for pid in listing:
        try:
            if Path(f"/proc/{pid}/cwd").readlink() == folder:
                found.append(int(pid))
        except OSError:
            continue
    return found
