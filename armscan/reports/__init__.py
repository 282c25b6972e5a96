"""HTML reports that need no server, and the comparison of any runs."""
