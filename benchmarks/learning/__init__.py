"""What agents reach, beside baselines and published curves."""
