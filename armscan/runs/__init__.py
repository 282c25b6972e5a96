"""The runs of a tracking store: list, show, stop, prune and reproduce them; export and register policies."""
