"""The runs of a tracking store: list, show, prune, reproduce; policies exported and registered."""
