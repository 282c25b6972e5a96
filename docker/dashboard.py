"""Optuna's dashboard of the studies in ARMSCAN_STORAGE, with the options of its own program.

That one refuses a database without tables, as it is before the first worker has come. Here they are made first, with
the lock that workers make them with, too.
"""

from __future__ import annotations

import os
import sys

from sqlalchemy import make_url

from armscan.sweeps.storage import open_storage

PROGRAM = "optuna-dashboard"

uri = os.environ["ARMSCAN_STORAGE"]
open_storage(uri, where="ARMSCAN_STORAGE", is_patient=True)
# Everybody can read the words of a process: a password that stands in the address is not passed on with them.
address = make_url(uri).set(drivername="postgresql+psycopg").render_as_string(hide_password=True)
os.execvp(PROGRAM, [PROGRAM, address, *sys.argv[1:]])
