"""Optuna storages."""
