"""Run the command `armscan` as `python -m armscan`."""

import sys

from armscan.cli.main import main

sys.exit(main())
