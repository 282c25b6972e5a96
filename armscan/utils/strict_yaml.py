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
# YAML 1.1 reads 010 as 8, 008 as a text, 1:30 as 90 and 1_0 as 10.
MISREAD = re.compile(r"[-+]?(0[0-9_]+|[0-9]+_[0-9_]*(\.[0-9_]*)?|[0-9][0-9_]*(:[0-5]?[0-9])+(\.[0-9_]*)?)")


def load_yaml(text: str | bytes) -> Any:
    """Return the contents of a YAML file.

    Raises:
        ValueError: If it is nested more than 50 deep, has more than a million nodes with its aliases expanded, has a
            number of more than 1,000 characters, or one that YAML 1.1 reads as another (010, 1:30, 1_0), or a mapping
            has a key twice.
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
            if isinstance(event, yaml.ScalarEvent):
                _check_number(event)
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


def _check_number(event: yaml.ScalarEvent) -> None:
    """Raise `ValueError` if a scalar is a number that is too long, or that would be read as another."""
    is_plain = event.implicit[0] and not event.implicit[1]
    if len(event.value) > MAX_NUMBER_CHARS and (event.tag is not None or (is_plain and NUMBER.fullmatch(event.value))):
        raise ValueError(
            f"{event.value[:20]}... has {len(event.value)} characters, but a number has at most {MAX_NUMBER_CHARS}"
        )
    if is_plain and MISREAD.fullmatch(event.value):
        raise ValueError(
            f"it holds {event.value}, which YAML would read as another number or as a text: write a decimal number "
            f'without leading zeros, colons and underscores, or a text in quotes ("{event.value}")'
        )


def check_no_duplicates(keys: list[str]) -> None:
    """Raise `ValueError` if a key appears twice."""
    if len(set(keys)) < len(keys):
        raise ValueError(f"the key {Counter(keys).most_common(1)[0][0]!r} appears twice")
