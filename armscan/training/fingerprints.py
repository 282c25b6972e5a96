"""Fingerprints of volumes: equal for equal volumes, independent of file names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import TypeAdapter, ValidationError

from armscan.errors import ChangedVolumesError

# By part of the split (training, validation, test) and the volume's name.
Fingerprints = dict[str, dict[str, str]]


def fingerprints_in(record: bytes | Any, where: str) -> Fingerprints:
    """Return the fingerprints of a record.

    Args:
        record: JSON text or plain dictionaries, as they were stored.
        where: Place of the record, for errors.

    Raises:
        ChangedVolumesError: If it is not a record of volumes.
    """
    reader = TypeAdapter(Fingerprints)
    try:
        return reader.validate_json(record) if isinstance(record, bytes) else reader.validate_python(record)
    except ValidationError as error:
        raise ChangedVolumesError(f"{where}: is not a record of volumes and their fingerprints") from error


def check_unchanged(then: Mapping[str, Mapping[str, str]], now: Mapping[str, Mapping[str, str]], those_of: str) -> None:
    """Raise `ChangedVolumesError` if a volume is new, gone, changed or in another part of the split.

    Args:
        then: Earlier fingerprints.
        now: Fingerprints of today's volumes.
        those_of: End of the message "not those that ...".
    """
    for part, prints in now.items():
        before = then.get(part, {})
        changes = {
            "not there any more": before.keys() - prints.keys(),
            "new": prints.keys() - before.keys(),
            "changed": {name for name in before.keys() & prints.keys() if before[name] != prints[name]},
        }
        for change, names in changes.items():
            if names:
                raise ChangedVolumesError(
                    f"the {part} volumes are not those that {those_of}: {', '.join(sorted(names))} "
                    f"{'is' if len(names) == 1 else 'are'} {change}"
                )
