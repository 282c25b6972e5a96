"""Validation, files, retries, logging, processes, text."""
