"""Several runs: grids, job processes, launchers."""
