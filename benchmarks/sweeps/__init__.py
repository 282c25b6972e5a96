"""Benchmarks of studies: overhead, failures of workers and storage, and decisions."""
