"""The runs of a tracking store: list, show, prune and reproduce them; export and register policies."""
