"""The configuration: any line of it can be changed on the command line."""

# Whoever reads these files imports this package first, and with it what they name services by.
from armscan.services import RESOLVER

__all__ = ["RESOLVER"]
