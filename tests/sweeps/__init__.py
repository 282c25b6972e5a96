"""Tests of `armscan.sweeps`."""
