"""What an error of a database says: that it cannot be reached for now, or that what it was told is wrong."""

from __future__ import annotations

from optuna.exceptions import StorageInternalError
from sqlalchemy.exc import DBAPIError, OperationalError, SQLAlchemyError

# What SQLite calls a file that somebody else has locked, or that lies where nothing can be read for now.
AWAY_IN_SQLITE = ("SQLITE_BUSY", "SQLITE_LOCKED", "SQLITE_IOERR")


class ConnectionLostError(Exception):
    """The connection was lost in the middle of a transaction."""


def why_away(error: BaseException) -> str | None:
    """Returns why a database cannot be reached for now, None where an error says anything else."""
    return _reason(error) if is_away(error) else None


def is_away(error: BaseException | None) -> bool:
    """Whether an error says that a storage cannot be reached for now, and not that what it was told is wrong."""
    # Optuna wraps errors, and may have asked again on a connection that was lost: the first one says why.
    while isinstance(error, StorageInternalError | SQLAlchemyError) and not isinstance(error, DBAPIError):
        error = error.__cause__ or error.__context__
    if not isinstance(error, DBAPIError):
        return isinstance(error, ConnectionLostError)
    in_sqlite = getattr(error.orig, "sqlite_errorname", None)
    if in_sqlite is not None:
        return str(in_sqlite).startswith(AWAY_IN_SQLITE)
    return error.connection_invalidated or isinstance(error, OperationalError)


def _reason(error: BaseException) -> str:
    while not isinstance(error, DBAPIError) and (cause := error.__cause__ or error.__context__) is not None:
        error = cause
    told = str(error.orig if isinstance(error, DBAPIError) else error).strip()
    return told.splitlines()[0] if told else type(error).__name__
