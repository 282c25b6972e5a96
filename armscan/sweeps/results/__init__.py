"""Results of a study."""
