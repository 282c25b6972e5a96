"""Optuna's dashboard of the studies in ARMSCAN_STORAGE, with the options of its own program.

That one refuses a database without tables, as it is before the first worker has come. Here they are made first, with
the lock that workers make them with, too.
"""

from __future__ import annotations

import os
import sys

from sqlalchemy import make_url

from armscan.sweeps.storage.storage import open_storage

PROGRAM = "optuna-dashboard"

uri = os.environ["ARMSCAN_STORAGE"]
open_storage(uri, where="ARMSCAN_STORAGE", retry=True)
address = make_url(uri).set(drivername="postgresql+psycopg")
os.execvp(PROGRAM, [PROGRAM, str(address), *sys.argv[1:]])
