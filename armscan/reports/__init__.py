"""Reports for people: pages that need no server, and the comparison of any runs."""
