"""Labelling of planes, and the explorer."""
