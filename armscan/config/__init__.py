"""Configuration: sources, composition, services, credentials, error messages."""
