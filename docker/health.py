"""Health check of a worker: exit with 0 if one is running in this container."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

from armscan.sweeps.workers.supervisor import local_workers

starts = Path("studies").glob(f"*/workers/*_{socket.gethostname()}_*")
sys.exit(0 if any(local_workers(folder) for folder in starts) else 1)
