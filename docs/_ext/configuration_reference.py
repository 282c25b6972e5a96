"""The directive `configuration`: the keys of conf/, from the classes that they build and the comments beside them."""

import dataclasses
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

from armscan.agents.hyperparameters import Parameters
from armscan.config.sources import config_folder
from armscan.envs import ArmscanEnv, EnvFactory
from armscan.envs.rules import Rules
from armscan.sweeps.space.space import Space
from armscan.sweeps.study.settings import StudySettings

TARGET = "_target_"
# OmegaConf's mark of a key without a default.
REQUIRED = "???"
STUDY = "study."


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
    """Read the arguments' types, as YAML has them: a sequence is a list."""
    target = Rules if target is EnvFactory else target
    return {
        name: re.sub(r"\b(?:Sequence|tuple)\[.*\]", "list", str(argument.annotation)).replace("None", "null")
        for name, argument in inspect.signature(target).parameters.items()
        if argument.annotation is not inspect.Parameter.empty
    }


def argument_ranges(target: Any) -> dict[str, str]:
    """Read the limits of a dataclass's numbers: the metadata of its fields, and 1 for whole numbers of learners."""
    ranges = {}
    for each in dataclasses.fields(target) if dataclasses.is_dataclass(target) else ():
        if "limits" in each.metadata:
            limits = each.metadata["limits"]
            words = [f"{name.replace('_', ' ')} {limit:g}" for name, limit in limits.items()]
            ranges[each.name] = f"Range: {', '.join(words)}."
        elif inspect.isclass(target) and issubclass(target, Parameters) and each.type == "int":
            ranges[each.name] = "Range: at least 1."
    return ranges


def of_study(key: str) -> tuple[str, str]:
    """Read the type of a key of the section `study`, and what it allows, as its errors name it."""
    model: Any = StudySettings
    *sections, name = key.split(".")
    for section in sections:
        model = model.model_fields[section].annotation
    field = model.model_fields.get(name)
    if field is None:
        return "", ""
    of_type = field.annotation.__name__ if inspect.isclass(field.annotation) else str(field.annotation)
    # A target and its arguments, as `study.terminator` has them.
    of_type = "dict" if field.annotation is Space or "Mapping" in of_type else of_type.replace("None", "null")
    return of_type, f"Allowed: {field.description}." if field.description else ""


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
    texts, types, ranges = (
        (argument_texts(target), argument_types(target), argument_ranges(target)) if target else ({}, {}, {})
    )
    beside = comments(keys, source)
    for key, value in keys.items():
        if key in (TARGET, "defaults", "hydra", "_partial_", "_recursive_"):
            continue
        if isinstance(value, CommentedMap):
            yield from rows(value, source, f"{prefix}{key}.")
        # What only repeats another key is described there.
        elif not str(value).startswith("${"):
            of_type, allowed = of_study(f"{prefix}{key}".removeprefix(STUDY)) if prefix.startswith(STUDY) else ("", "")
            text = in_yaml(texts[key]) if texts.get(key) else beside[key]
            changes = "A schedule can change it." if key in getattr(target, "SCHEDULABLE", ()) else ""
            words = " ".join(f"{text} {ranges.get(key, allowed)} {changes}".split())
            yield f"{prefix}{key}", types.get(key) or kind(value) or of_type, shown(value), words


def shown(value: Any) -> str:
    """Write a default; of a section that builds an object, only the name of its class."""
    if isinstance(value, list):
        return f"[{', '.join(map(shown, value))}]"
    if isinstance(value, CommentedMap) and TARGET in value:
        return str(value[TARGET]).rpartition(".")[2]
    return "required" if value == REQUIRED else json.dumps(value)


def in_yaml(text: str) -> str:
    """Write a Python argument's description for YAML, without its default: the table has that of the configuration."""
    text = re.sub(r"Default: None, ", "null: ", text)
    text = re.sub(r" *Default: (?:[^.]|\.(?=\S))*\.", "", text)
    return re.sub(r"\b(?:None|True|False)\b", lambda word: {"None": "null"}.get(word[0], word[0].lower()), text)


def sources(keys: CommentedMap) -> Iterator[Path]:
    """List the source files of the classes that a file builds."""
    if TARGET in keys:
        target = get_object(keys[TARGET])
        target = ArmscanEnv if target is EnvFactory else target
        yield from (Path(inspect.getfile(each)) for each in getattr(target, "__mro__", [target])[:-1])
    for value in keys.values():
        if isinstance(value, CommentedMap):
            yield from sources(value)


def kind(value: Any) -> str:
    """Name the plain type of a value; empty where it refers to another key."""
    if value in (None, REQUIRED) or "${" in str(value):
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
        keys, source = load(path)
        for dependency in (path, *sources(keys)):
            self.env.note_dependency(str(dependency))
        group = Path(name).parent.name
        lines = [f"### `{group}={Path(name).stem}`" if group else "### All runs", ""]
        if group and source and source[0].startswith("# ") and "@package" not in source[0]:
            lines += [source[0][2:], ""]
        prefix = f"{group}." if group and "@package" not in source[0] else ""
        table = list(rows(keys, source, prefix))
        if table:
            lines += ["{.configuration}", "| key | type | default | meaning |", "| --- | --- | --- | --- |"]
            for key, type_, value, text in table:
                cells = (f"`{key}`", type_ and f"`{type_}`", f"`{value}`", text)
                lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        return self.parse_text_to_nodes("\n".join(lines) + "\n", allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("configuration", Configuration)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
