"""Tasks: the work of a trial."""
