"""Benchmarks of learning: trained agents beside baselines and published curves."""
