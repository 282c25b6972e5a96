"""Commands of the program `armscan`."""
