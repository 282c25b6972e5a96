"""Untrusted YAML, read within limits, which are checked on the events of libyaml before anything is built."""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import yaml

# Nested collections; a manifest has at most five, a configuration ten.
DEEPEST = 50
# A manifest of 10,000 volumes has 140,000.
MAX_NODES = 1_000_000
# Numbers in base 60 (1:30) take quadratic time, and Python prints none of more than 4,300 digits.
MAX_NUMBER_CHARS = 1000
NUMBER = re.compile(r"[-+]?[0-9][\w:.]*")


def load_yaml(text: str | bytes) -> Any:
    """Return the contents of a YAML file.

    Raises:
        ValueError: If it is nested more than 50 deep, has more than a million nodes with its aliases expanded, or a
            number of more than 1,000 characters, or a mapping has a key twice.
        yaml.YAMLError: If it is not YAML, or holds anything but plain values.
    """
    # The nodes in each open collection, and their number with all aliases expanded.
    open_nodes: list[list[yaml.NodeEvent]] = [[]]
    sizes, sizes_by_anchor = [0], dict[str | None, int]()
    for event in yaml.parse(text, yaml.CSafeLoader):
        if isinstance(event, yaml.CollectionEndEvent):
            nodes, size = open_nodes.pop(), sizes.pop()
            sizes[-1] += size
            sizes_by_anchor[open_nodes[-1][-1].anchor] = size
            if isinstance(event, yaml.MappingEndEvent):
                keys = [key.value for key in nodes[::2] if isinstance(key, yaml.ScalarEvent)]
                # The merge key may occur several times.
                check_no_duplicates([key for key in keys if key != "<<"])
        elif isinstance(event, yaml.NodeEvent):
            if isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_NUMBER_CHARS:
                _check_no_number(event)
            open_nodes[-1].append(event)
            sizes[-1] += sizes_by_anchor.get(event.anchor, 1) if isinstance(event, yaml.AliasEvent) else 1
            if isinstance(event, yaml.CollectionStartEvent):
                # Until it ends: a collection that contains itself is infinite.
                sizes_by_anchor[event.anchor] = MAX_NODES + 1
                open_nodes.append([])
                sizes.append(0)
        # The first of them is no collection, but the stream.
        if len(open_nodes) > DEEPEST + 1 or sizes[-1] > MAX_NODES:
            raise ValueError(
                f"it is nested more than {DEEPEST} deep, or has more than {MAX_NODES} nodes with its aliases expanded"
            )
    return yaml.load(text, yaml.CSafeLoader)


def _check_no_number(event: yaml.ScalarEvent) -> None:
    """Raise `ValueError` if a long scalar may be read as a number: with a tag, or if it looks like one."""
    is_quoted = event.implicit[1]
    if event.tag is not None or (not is_quoted and NUMBER.fullmatch(event.value)):
        raise ValueError(
            f"{event.value[:20]}... has {len(event.value)} characters, but a number has at most {MAX_NUMBER_CHARS}"
        )


def check_no_duplicates(keys: list[str]) -> None:
    """Raise `ValueError` if a key appears twice."""
    if len(set(keys)) < len(keys):
        raise ValueError(f"the key {Counter(keys).most_common(1)[0][0]!r} appears twice")
