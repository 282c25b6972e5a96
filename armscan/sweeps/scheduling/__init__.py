"""Scheduling of trials: the next trial, and its outcome."""
