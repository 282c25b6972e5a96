"""Sections of a configuration or a manifest, checked with Pydantic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from armscan.errors import InvalidValueError, listed

MAX_SHOWN_CHARS = 500


class Section(BaseModel):
    """Model that accepts no unknown keys and converts no values; a field's description states its allowed values."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True)

    @classmethod
    def read(cls, where: str, values: Mapping[str, Any]) -> Self:
        """Return the section with these values.

        Args:
            where: Key of the section in the configuration, for errors.
            values: Values by key.

        Raises:
            InvalidValueError: If a key is missing or unknown, or a value is not allowed.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            mistake = error.errors(include_url=False)[0]
            told = str(mistake["ctx"]["error"]) if mistake["type"] == "value_error" else ""
            line = told or cls._line(where, values, mistake["loc"])
            raise InvalidValueError(line) from error

    @classmethod
    def _line(cls, where: str, values: Mapping[str, Any], place: Sequence[str | int]) -> str:
        """Return a line with the key, the value received and what is allowed."""
        key = str(place[0])
        field = cls.model_fields.get(key)
        if field is None:
            return f"there is no key {key!r} in {where}, but only {listed(cls.model_fields)}"
        if key not in values:
            return f"{where}.{key} is not set, but it must be"
        model = field.annotation
        if len(place) > 1 and isinstance(model, type) and issubclass(model, Section):
            return model._line(f"{where}.{key}", values[key], place[1:])
        received = repr(values[key])
        if len(received) > MAX_SHOWN_CHARS:
            received = f"{received[:MAX_SHOWN_CHARS]}..."
        return f"{where}.{key} is {received}, but it must be {field.description}"
