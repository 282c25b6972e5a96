"""What a study costs beside its trials, and what survives its failures."""
