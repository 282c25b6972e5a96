"""Values as Hydra reads them on the command line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from hydra.core.override_parser.types import Quote, QuotedString

PLAIN_TEXT = re.compile(r"(?!(?i:true|false|null|nan|inf)$)[A-Za-z_][\w./\-]*")


def hydra_literal(value: Any) -> str:
    """Return a value as Hydra reads it on the command line."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{','.join(map(hydra_literal, value))}]"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{hydra_literal(each)}" for key, each in value.items()) + "}"
    # Not the literal of a list or mapping, nor a string that Hydra reads as one anyway.
    if isinstance(value, str) and not value.startswith(("[", "{")) and not PLAIN_TEXT.fullmatch(value):
        return QuotedString(value, Quote.single).with_quotes()
    return str(value)
