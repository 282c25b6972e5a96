"""Names and values within MLflow's limits; a truncated value names the file of the run that has it in full."""

from __future__ import annotations

import json
import posixpath
import re
from collections.abc import Mapping
from typing import Any

from armscan.utils.files import sha256
from armscan.utils.run_files import CONFIG_FILE

# MLflow's own limits; a store refuses a whole request if one value is longer.
MAX_KEY_CHARS, MAX_PARAM_CHARS, MAX_TAG_CHARS = 250, 6000, 8000
# Characters that a name must not have anywhere, and at either end, where they would make it a folder.
REFUSED, REFUSED_ENDS = re.compile(r"[^\w\-. :/]"), "./"
N_SUM_CHARS = 8


def params_of(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the leaves of a configuration as MLflow parameters; a truncated value names the file with all of it."""
    leaves = flatten(config)
    return {name_of(key): truncate(str(value), MAX_PARAM_CHARS, CONFIG_FILE) for key, value in leaves.items()}


def tags_of(tags: Mapping[str, str], whole_in: str = CONFIG_FILE) -> dict[str, str]:
    """Return tags as MLflow accepts them; a truncated value names the file with all of it."""
    return {name_of(key): truncate(value, MAX_TAG_CHARS, whole_in) for key, value in tags.items()}


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the leaves of nested mappings by their dotted keys; lists are leaves, written as JSON."""
    leaves: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            leaves |= flatten(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = json.dumps(value) if isinstance(value, list | dict) else value
    return leaves


def metric_name_of(key: str) -> str:
    """Return the key of a metric as a name that MLflow accepts; its last part, such as `mean_steps`, stays."""
    group, _, metric = key.rpartition("/")
    return name_of(f"{name_of(group, MAX_KEY_CHARS - len(metric) - 1)}/{metric}" if group else metric)


def name_of(key: str, max_chars: int = MAX_KEY_CHARS) -> str:
    """Return a key as a name that MLflow accepts; a changed one ends with a checksum, so that names stay distinct."""
    name = posixpath.normpath(REFUSED.sub("_", key).strip(REFUSED_ENDS).replace("..", "._") or "_")
    if name == key and len(key) <= max_chars:
        return key
    return f"{name[: max_chars - N_SUM_CHARS - 1]}-{sha256(key.encode())[:N_SUM_CHARS]}"


def truncate(text: str, at_most: int, whole_in: str) -> str:
    """Return a string of at most `at_most` characters; a truncated one ends by naming the file with all of it."""
    if len(text) <= at_most:
        return text
    # The checksum distinguishes strings that begin alike.
    summed = sha256(text.encode(errors="surrogatepass"))[:N_SUM_CHARS]
    note = f" ... cut: {whole_in} has all {len(text)} characters ({summed})"
    return text[: at_most - len(note)] + note
