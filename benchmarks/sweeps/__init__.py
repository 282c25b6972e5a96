"""Benchmarks of studies: cost beside the trials, failures, and how studies decide."""
