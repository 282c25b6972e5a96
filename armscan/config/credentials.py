"""Passwords of services: they come from the environment or a file; an address that contains one is refused."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from armscan.errors import InvalidValueError

if TYPE_CHECKING:
    from sqlalchemy import URL

# Of the studies' database, of a database with runs, and (read by MLflow itself) of an MLflow server.
STORAGE_PASSWORD = "ARMSCAN_STORAGE_PASSWORD"
TRACKING_PASSWORD = "ARMSCAN_TRACKING_PASSWORD"
SERVER_PASSWORD = "MLFLOW_TRACKING_PASSWORD"
SERVER_SECRETS = (SERVER_PASSWORD, "MLFLOW_TRACKING_TOKEN")
# Read by the clients of PostgreSQL.
PGPASSWORD = "PGPASSWORD"
# With this suffix, a variable holds the path of a file with the password, as containers receive secrets.
FILE_SUFFIX = "_FILE"
# USER:PASSWORD@, where the password of a database may contain a slash; or an option such as sslpassword=.
PASSWORD = re.compile(
    r"""(?<![\w+.-])(?:
    https?://[^/?#,]*:(?:(?!,\s*[\w+.-]+://)[^/?#])*@
    | (?!https?:|sqlite|file)[\w+.-]+://[^/?#:,]*:(?:(?!,\s*[\w+.-]+://)[^?#])*@
    | (?!sqlite|file)[\w+.-]+://.*[?&]\w*password=.)""",
    re.VERBOSE,
)
ACCOUNT = re.compile(r"(?<=://)([^/@:?#\s]*):([^/@?#\s]*)@")
MASK = "***"
# A shorter password also occurs in unrelated words, and masking those would reveal it.
MIN_MASKED_CHARS = 4


def check_address(name: str, uri: str) -> None:
    """Raise `InvalidValueError` if an address, or one of several in a text, contains a password.

    Args:
        name: Origin of the address, such as `tracking.uri`.
        uri: Address or text.
    """
    if (found := PASSWORD.search(uri)) is None:
        return
    if found[0].startswith("http"):
        instead = f"set MLFLOW_TRACKING_USERNAME and {SERVER_PASSWORD}"
    else:
        variable = STORAGE_PASSWORD if "storage" in name.partition(" ")[0].lower() else TRACKING_PASSWORD
        instead = f"put it in ~/.pgpass or the file that PGPASSFILE names, or set {variable}"
    raise InvalidValueError(f"{name} has a password in its address, where others could read it: {instead}")


def check_overrides(overrides: Sequence[str]) -> None:
    """Raise `InvalidValueError` if an override `key=value` contains a password."""
    for override in overrides:
        key, _, value = override.partition("=")
        # Hydra removes the backslash of an escaped colon, and reads several values.
        check_address(key, value.replace("\\", ""))


def read_password(variable: str) -> str | None:
    """Return a password from an environment variable, or from the file that `{variable}_FILE` names; None if unset.

    Raises:
        InvalidValueError: If the file cannot be read or is empty.
    """
    if password := os.environ.get(variable):
        return password
    name = variable + FILE_SUFFIX
    file = os.environ.get(name)
    if not file:
        return None
    try:
        password = Path(file).read_text().rstrip("\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise InvalidValueError(f"{name} is {file!r}, but it cannot be read ({reason})") from None
    if not password:
        raise InvalidValueError(f"{name} is {file!r}, but that file is empty")
    return password


def database_url(uri: str, variable: str) -> URL:
    """Return the URL of a database with its driver and, where this variable or its file sets one, its password."""
    # Deferred: most commands do not need it.
    from sqlalchemy import make_url

    url = make_url(uri)
    if url.drivername == "postgresql":
        url = url.set(drivername="postgresql+psycopg")
    if url.get_backend_name() == "postgresql" and (password := read_password(variable)):
        url = url.set(password=password)
    return url


def mask_passwords(text: str) -> str:
    """Mask the passwords in a string: those of addresses, of the environment, and of the files that it names."""
    text = ACCOUNT.sub(rf"\1:{MASK}@", text)
    for variable in (STORAGE_PASSWORD, TRACKING_PASSWORD, *SERVER_SECRETS, PGPASSWORD):
        # Of a file that cannot be read, nobody has the password.
        with suppress(InvalidValueError):
            password = read_password(variable)
            if password is not None and len(password) >= MIN_MASKED_CHARS:
                text = text.replace(password, MASK)
    return text
