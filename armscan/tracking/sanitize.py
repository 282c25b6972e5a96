"""Names and values within MLflow's limits: longer ones are shortened and say so; a file of the run has them whole."""

from __future__ import annotations

import hashlib
import json
import posixpath
import re
from collections.abc import Mapping
from typing import Any

from armscan.utils.files import CONFIG_FILE

# MLflow's own limits; a store refuses a whole request for one value that is longer.
MAX_KEY_CHARS, MAX_PARAM_CHARS, MAX_TAG_CHARS = 250, 6000, 8000
# What may stand in a name, and beginnings that are taken for a folder.
REFUSED, REFUSED_ENDS = re.compile(r"[^\w\-. :/]"), "./"
N_SUM_CHARS = 8


def params_of(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the leaves of a configuration as MLflow's parameters; a cut value names the file with the whole."""
    leaves = flattened(config)
    return {name_of(key): shortened(str(value), MAX_PARAM_CHARS, CONFIG_FILE) for key, value in leaves.items()}


def tags_of(tags: Mapping[str, str], whole_in: str = CONFIG_FILE) -> dict[str, str]:
    """Return tags as MLflow accepts them; a cut value names the file with the whole."""
    return {name_of(key): shortened(value, MAX_TAG_CHARS, whole_in) for key, value in tags.items()}


def flattened(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the leaves of nested mappings by their dotted keys; lists are leaves, written as JSON."""
    leaves: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            leaves |= flattened(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = json.dumps(value) if isinstance(value, list | dict) else value
    return leaves


def name_of(key: str) -> str:
    """Return a key as MLflow takes it for a name; a changed one ends with a checksum, so that no two become one."""
    name = posixpath.normpath(REFUSED.sub("_", key).strip(REFUSED_ENDS).replace("..", "._") or "_")
    if name == key and len(key) <= MAX_KEY_CHARS:
        return key
    return f"{name[: MAX_KEY_CHARS - N_SUM_CHARS - 1]}-{hashlib.sha256(key.encode()).hexdigest()[:N_SUM_CHARS]}"


def shortened(text: str, at_most: int, whole_in: str) -> str:
    """Return a string of at most so many characters; one that is cut ends with the file that has all of it."""
    if len(text) <= at_most:
        return text
    # Of two that begin alike, the sums differ.
    summed = hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()[:N_SUM_CHARS]
    note = f" ... cut: {whole_in} has all {len(text)} characters ({summed})"
    return text[: at_most - len(note)] + note
