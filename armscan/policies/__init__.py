"""Trained policies as models: written, checked, kept with their runs, registered."""
