"""A study: settings, arguments, phases."""
