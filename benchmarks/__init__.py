"""Benchmarks: scripts that measure speed, learning and studies."""
