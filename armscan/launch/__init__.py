"""Several runs: multiruns, job processes, launchers."""
