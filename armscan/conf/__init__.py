"""The configuration: any line of it can be changed on the command line."""

from armscan.services import register_resolver

# Whoever reads these files imports this package first.
register_resolver()
