"""Passwords of services: they come from the environment or a file, and stand in no address that is written down."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

from armscan.errors import InvalidValueError

if TYPE_CHECKING:
    from sqlalchemy import URL

# Of the database with the studies; of an MLflow server, as MLflow itself reads them; of a database with runs.
STORAGE_PASSWORD = "ARMSCAN_STORAGE_PASSWORD"
TRACKING_USER, SERVER_PASSWORD = "MLFLOW_TRACKING_USERNAME", "MLFLOW_TRACKING_PASSWORD"
TRACKING_PASSWORD = "ARMSCAN_TRACKING_PASSWORD"
# A variable of this name holds a file's place instead, as containers are given their secrets.
IN_A_FILE = "_FILE"
ACCOUNT = re.compile(r"(?<=://)([^/@:?#\s]*):([^/@?#\s]*)@")
IN_A_QUERY = re.compile(r"(?<=[?&])\w*password=([^&]*)&?")
REPLACED_BY = "***"
# A shorter one is found in words that have nothing to do with it, and what is left of them would tell it.
FEWEST_CHARS = 4


def without_password(uri: str) -> str:
    """Returns an address as it may be shown."""
    scheme, separator, account, rest = _parts(uri)
    shown = f"{scheme}{separator}{account.partition(':')[0]}{'@' if account else ''}{rest}"
    return IN_A_QUERY.sub("", shown).rstrip("?&") if separator else uri


def password_in(uri: str) -> str | None:
    """Returns the password that stands in an address, None where none does."""
    _, separator, account, rest = _parts(uri)
    _, colon, password = account.partition(":")
    queried = IN_A_QUERY.search(rest) if separator else None
    found = password if colon else queried[1] if queried else None
    return unquote(found) if found else None


def _parts(uri: str) -> tuple[str, str, str, str]:
    """Returns scheme, `://`, user with password, and the rest of an address; of a file the last alone."""
    scheme, separator, rest = uri.partition("://")
    if not separator or scheme.startswith(("sqlite", "file")):
        return "", "", "", uri
    # A password in the address of a database may have a slash in it.
    host_ends = re.search(r"[/?#]" if scheme.startswith("http") else r"[?]", rest)
    end = host_ends.start() if host_ends else len(rest)
    account, at, host = rest[:end].rpartition("@")
    is_account = bool(at) and "/" not in account.partition(":")[0]
    return (scheme, separator, account, host + rest[end:]) if is_account else (scheme, separator, "", rest)


def password_of(variable: str) -> str | None:
    """Returns the password that the environment holds, or a file that it names; None where there is none.

    Raises:
        InvalidValueError: if the file cannot be read.
    """
    if password := os.environ.get(variable):
        return password
    file = os.environ.get(variable + IN_A_FILE)
    if not file:
        return None
    name = variable + IN_A_FILE
    try:
        password = Path(file).read_text().rstrip("\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise InvalidValueError(f"{name} is {file!r}, but it cannot be read ({reason})") from None
    if not password:
        raise InvalidValueError(f"{name} is {file!r}, but that file is empty")
    return password


def database_url(uri: str, variable: str) -> URL:
    """Returns the address of a database with its driver, and with its password where it has none.

    Args:
        uri: of SQLite or PostgreSQL.
        variable: that holds the password.
    """
    # Deferred: most commands are answered without.
    from sqlalchemy import make_url

    url = make_url(uri)
    if url.drivername == "postgresql":
        url = url.set(drivername="postgresql+psycopg")
    if url.get_backend_name() == "postgresql" and url.password is None:
        url = url.set(password=password_of(variable))
    return url


def hand_over_storage(uri: str) -> str:
    """Keeps the password of a storage's address for this process and those that it starts; returns it without."""
    if password := password_in(uri):
        os.environ[STORAGE_PASSWORD] = password
    return without_password(uri)


def hand_over_tracking(uri: str) -> str:
    """Keeps the password of a tracking store's address for this process and those that it starts; returns it without.

    That of a server is kept where MLflow itself looks for it, with the user's name.
    """
    password = password_in(uri)
    if password is None:
        return uri
    if not uri.startswith("http"):
        os.environ[TRACKING_PASSWORD] = password
        return without_password(uri)
    scheme, separator, account, rest = _parts(uri)
    os.environ[TRACKING_USER], os.environ[SERVER_PASSWORD] = unquote(account.partition(":")[0]), password
    return scheme + separator + rest


def masked(text: str) -> str:
    """Returns a text, an error's say, without the passwords of this process and of any address in it."""
    text = ACCOUNT.sub(rf"\1:{REPLACED_BY}@", text)
    for variable in (STORAGE_PASSWORD, TRACKING_PASSWORD, SERVER_PASSWORD):
        password = os.environ.get(variable, "")
        if len(password) >= FEWEST_CHARS:
            text = text.replace(password, REPLACED_BY)
    return text


def check_written(key: str, uri: str) -> None:
    """Raises `InvalidValueError` where an address has a password in a configuration, which is written into files."""
    if password_in(uri) is not None:
        raise InvalidValueError(
            f"{key} is {without_password(uri)!r} with a password, which would be written into the files of each run: "
            f"set {_variable_of(key)}, or give the whole address in conf/local/services.yaml"
        )


def check_words(words: Sequence[str]) -> None:
    """Raises `InvalidValueError` for words of a command line with a password, which everybody on a machine can read."""
    for word in words:
        key, _, value = word.partition("=")
        if password_in(value.strip("'\"")) is not None:
            raise InvalidValueError(
                f"{key} has a password, which everybody on this machine could read on the command line: set "
                f"{_variable_of(key)}, or give the whole address in conf/local/services.yaml"
            )


def _variable_of(key: str) -> str:
    return STORAGE_PASSWORD if key.endswith("storage") else f"{SERVER_PASSWORD} or {TRACKING_PASSWORD}"
