"""Optuna's dashboard of the studies in ARMSCAN_STORAGE, with the options of its own program.

That one refuses a database without tables, as it is before the first worker has come. Here they are made first, with
the lock that workers make them with, too.
"""

from __future__ import annotations

import os
import sys

from armscan.sweeps.storage import open_storage, without_password

PROGRAM = "optuna-dashboard"

uri = os.environ["ARMSCAN_STORAGE"]
open_storage(uri, where="ARMSCAN_STORAGE", is_patient=True)
# Without a password: everybody can read the words of a process.
address = without_password(uri).replace("postgresql://", "postgresql+psycopg://", 1)
os.execvp(PROGRAM, [PROGRAM, address, *sys.argv[1:]])
