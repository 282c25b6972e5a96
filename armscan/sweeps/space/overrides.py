"""The values that a trial tries: as Optuna keeps them, and as the command line has them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from hydra.core.override_parser.types import Quote, QuotedString

from armscan.config.legacy import renamed

PLAIN_TEXT = re.compile(r"(?!(?i:true|false|null|nan|inf)$)[A-Za-z_][\w./\-]*")
Value = bool | int | float | str | None


def as_kept(value: Any) -> Value:
    """Return a value as Optuna keeps it: a number or a text; of a list how it is written."""
    kept: Value = written(value) if isinstance(value, list | tuple | Mapping) else value
    return kept


def overrides_of(chosen: Mapping[str, Value]) -> list[str]:
    """Return values as they are written on the command line, those of earlier versions by their new names."""
    return [f"{name}={written(value)}" for name, value in renamed(chosen).items()]


def written(value: Any) -> str:
    """Return a value as Hydra reads it on the command line."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{','.join(map(written, value))}]"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{written(each)}" for key, each in value.items()) + "}"
    # Neither that of a list, nor one in which nothing but a text is read.
    if isinstance(value, str) and not value.startswith(("[", "{")) and not PLAIN_TEXT.fullmatch(value):
        return QuotedString(value, Quote.single).with_quotes()
    return str(value)
