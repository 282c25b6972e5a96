"""The configuration: any line of it can be changed on the command line."""

# Whoever reads these files imports this package first, and with it what they name services by.
import armscan.services  # noqa: F401
