"""Validation, files, retries, logging, threads."""
