"""The files in docker/, read as an engine reads them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from tests.support import REPOSITORY

FOLDER = REPOSITORY / "docker"
COMPOSE, CUDA, WORKERS = FOLDER / "compose.yaml", FOLDER / "compose.cuda.yaml", FOLDER / "kubernetes" / "workers.yaml"
# The forms in use: ${NAME:-default}, whose default also replaces an empty value, and ${NAME-default}.
VARIABLE = re.compile(r"\$\{(?P<name>\w+)(?P<kind>:?-)(?P<default>[^}$]*)\}")


def read_compose(path: Path = COMPOSE, **given: str) -> dict[str, Any]:
    """Read a compose file.

    Args:
        path: Path of the file.
        **given: Values of the variables that are set.
    """
    return _interpolated(yaml.safe_load(path.read_text()), given)


def variables_of(path: Path) -> dict[str, str]:
    """Return the variables of a compose file with their defaults."""
    return {found["name"]: found["default"] for found in VARIABLE.finditer(path.read_text())}


def _interpolated(value: Any, given: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {key: _interpolated(each, given) for key, each in value.items()}
    if isinstance(value, list):
        return [_interpolated(each, given) for each in value]
    if not isinstance(value, str):
        return value

    def chosen(found: re.Match[str]) -> str:
        name, default = found["name"], found["default"]
        return (given.get(name) or default) if found["kind"] == ":-" else given.get(name, default)

    assert "$" not in VARIABLE.sub("", value), f"a variable of another form in {value!r}"
    return VARIABLE.sub(chosen, value)


@dataclass
class Image:
    """The image that the last stage of the Dockerfile makes.

    Args:
        environment: Environment variables.
        copied: Files of the repository by their paths in the image.
        words: Words of the instructions whose last occurrence counts, such as `USER`.
    """

    environment: dict[str, str] = field(default_factory=dict)
    copied: dict[str, Path] = field(default_factory=dict)
    words: dict[str, str] = field(default_factory=dict)

    @property
    def entrypoint(self) -> list[str]:
        """The program that runs every command."""
        return list(json.loads(self.words["ENTRYPOINT"]))

    @property
    def healthcheck(self) -> list[str]:
        """The command that checks the health of a container."""
        return list(json.loads(self.words["HEALTHCHECK"].partition(" CMD ")[2]))


def instructions() -> list[tuple[str, str]]:
    """Return the Dockerfile's instructions, each with its words."""
    lines = (FOLDER / "Dockerfile").read_text().splitlines()
    text = "\n".join(line for line in lines if not line.startswith("#")).replace("\\\n", " ")
    split = (line.partition(" ") for line in text.splitlines() if line.strip())
    return [(name, " ".join(words.split())) for name, _, words in split]


def read_image() -> Image:
    """Read the Dockerfile."""
    image = Image()
    for name, words in instructions():
        if name == "FROM":
            image = Image()
        elif name == "ENV":
            image.environment |= dict(pair.split("=", 1) for pair in words.split())
        elif name == "COPY" and not words.startswith("--"):
            *sources, target = words.split()
            image.copied |= {str(PurePosixPath(target, Path(each).name)): REPOSITORY / each for each in sources}
        else:
            image.words[name] = words
    return image
