"""The directive `configuration`: the keys of conf/, from the classes that they build and the comments beside them."""

import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hydra.utils import get_object
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective, nodes

from armscan.config.sources import config_folder
from armscan.envs import ArmscanEnv, EnvFactory

TARGET = "_target_"


def argument_texts(target: Any) -> dict[str, str]:
    """Read the arguments' descriptions: in a Google docstring, or below the fields of a dataclass."""
    # What it passes on to the environment is described there.
    target = ArmscanEnv if target is EnvFactory else target
    of_fields = {
        name: " ".join(lines)
        for owner in (reversed(target.__mro__) if inspect.isclass(target) else ())
        if owner.__module__.startswith("armscan.")
        for (class_name, name), lines in ModuleAnalyzer.for_module(owner.__module__).find_attr_docs().items()
        if class_name == owner.__name__
    }
    section = re.search(r"^Args:\n((?: {4}.*\n?|\n)*)", inspect.getdoc(target) or "", re.MULTILINE)
    entries = re.findall(r"^ {4}(\w+): ((?:.*\n?(?: {8}.*\n?)*))", section[1] if section else "", re.MULTILINE)
    return of_fields | {name: " ".join(text.split()) for name, text in entries}


def argument_types(target: Any) -> dict[str, str]:
    """Read the arguments' types as they are written."""
    return {
        name: str(argument.annotation).removeprefix("typing.")
        for name, argument in inspect.signature(target).parameters.items()
        if argument.annotation is not inspect.Parameter.empty
    }


def comments(keys: CommentedMap, source: list[str]) -> dict[str, str]:
    """Read the comments on the lines above each key."""
    texts = {}
    for key in keys:
        line = keys.lc.key(key)[0]
        above: list[str] = []
        while line > 0 and source[line - 1].lstrip().startswith("# "):
            line -= 1
            above.insert(0, source[line].lstrip()[2:])
        # The comment at a file's head describes the file.
        texts[key] = " ".join(above) if line > 0 else ""
    return texts


def rows(keys: CommentedMap, source: list[str], prefix: str) -> Iterator[tuple[str, str, str, str]]:
    """List the keys below a prefix: name, type, default, meaning."""
    target = get_object(keys[TARGET]) if TARGET in keys else None
    texts, types = (argument_texts(target), argument_types(target)) if target else ({}, {})
    beside = comments(keys, source)
    for key, value in keys.items():
        if key in (TARGET, "defaults", "hydra", "_partial_", "_recursive_"):
            continue
        if isinstance(value, CommentedMap):
            yield from rows(value, source, f"{prefix}{key}.")
        # What only repeats another key is described there.
        elif not str(value).startswith("${"):
            yield f"{prefix}{key}", types.get(key) or kind(value), json.dumps(value), texts.get(key) or beside[key]


def kind(value: Any) -> str:
    """Name the plain type of a value; empty where it refers to another key."""
    if value is None or "${" in str(value):
        return ""
    return next(each.__name__ for each in (bool, int, float, str, list, dict) if isinstance(value, each))


def load(path: Path) -> tuple[CommentedMap, list[str]]:
    """Read a file with the positions of its keys."""
    text = path.read_text()
    return YAML().load(text) or CommentedMap(), text.splitlines()


class Configuration(SphinxDirective):
    """`configuration:: FILE...`: the keys of files in conf/, such as config.yaml and agent/sac.yaml."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Make a section with a table for each file."""
        return [node for name in self.content for node in self.section(name.strip())]

    def section(self, name: str) -> list[nodes.Node]:
        """Make a file's heading, first comment and table."""
        path = config_folder() / name
        self.env.note_dependency(str(path))
        keys, source = load(path)
        group = Path(name).parent.name
        lines = [f"### `{group}={Path(name).stem}`" if group else "### All runs", ""]
        if group and source and source[0].startswith("# ") and "@package" not in source[0]:
            lines += [source[0][2:], ""]
        prefix = f"{group}." if group and "@package" not in source[0] else ""
        table = list(rows(keys, source, prefix))
        if table:
            lines += ["| key | type | default | meaning |", "| --- | --- | --- | --- |"]
            for key, type_, value, text in table:
                cells = (f"`{key}`", type_ and f"`{type_}`", f"`{value}`", text)
                lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        return self.parse_text_to_nodes("\n".join(lines) + "\n", allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("configuration", Configuration)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
