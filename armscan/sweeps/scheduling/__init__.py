"""Which trial runs next, and what becomes of it."""
