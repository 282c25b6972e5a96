"""Configuration: where it is, services, credentials, error messages."""
