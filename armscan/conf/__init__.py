"""Hydra's configuration groups; they travel in the wheel."""
