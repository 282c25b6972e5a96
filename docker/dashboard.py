"""Optuna's dashboard of the studies in ARMSCAN_STORAGE: `dashboard.py ADDRESS:PORT`.

It serves only requests for a host in DASHBOARD_HOSTS. Optuna's own program serves any host, and refuses a database
without tables, as it is before the first worker starts.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

from armscan.sweeps.storage.storage import open_storage
from armscan.ui.servers import start_dashboard

storage = open_storage(os.environ["ARMSCAN_STORAGE"], where="ARMSCAN_STORAGE", retry=True)
hosts = os.environ["DASHBOARD_HOSTS"].split(",")
host, port = sys.argv[1].split(":")
print(start_dashboard(storage, Path("optuna.artifacts"), int(port), host=host, allowed_hosts=hosts), flush=True)
threading.Event().wait()
