"""`python -m armscan` is the program `armscan`."""

import sys

from armscan.cli.main import main

sys.exit(main())
