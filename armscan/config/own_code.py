"""Checksums of the code of the user's own classes: when it changes, the configuration stays the same."""

from __future__ import annotations

import ast
import functools
import importlib.util
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from hydra.utils import get_object

from armscan.config.trust import foreign_targets
from armscan.utils.files import PACKAGE_FOLDERS, sha256

N_CHARS = 16
# A longer list of checksums, which no tag could hold, is one checksum of all.
MAX_CHARS = 4000
ALL = "own_classes"
FUNCTIONS = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
INSTALLED = tuple(Path(path) for name, path in sysconfig.get_paths().items() if name.endswith(("lib", "stdlib")))


def own_code(config: Mapping[str, Any], further: Iterable[str] = ()) -> dict[str, str]:
    """Return a checksum of each module that the own classes of a configuration are from, and of those it imports.

    Installed packages are left out, because a run keeps their versions, and so are imports within functions.

    Args:
        config: Resolved configuration. What it names but cannot be imported is left out.
        further: Names of further classes. Default: none.
    """
    sums: dict[str, str] = {}
    names = [name for target in (*foreign_targets(config), *further) for name in _modules_of(target)]
    while names:
        name = names.pop()
        module = sys.modules.get(name)
        if name not in sums and module is not None and (file := _own_file(module)) is not None:
            sums[name], imported = _read(module, file)
            names += imported
    sums = dict(sorted(sums.items()))
    return sums if len(as_tag(sums)) <= MAX_CHARS else {ALL: sha256(as_tag(sums).encode())[:N_CHARS]}


def changed_modules(before: str | None, now: Mapping[str, str]) -> list[str]:
    """Return the names of modules whose code has changed, or that only one of both has.

    Args:
        before: Checksums as `as_tag` wrote them; None if a run has none: then nothing is known.
        now: Checksums of today's code.
    """
    if before is None:
        return []
    then = _sums_in(before)
    return sorted(name for name in then.keys() | now.keys() if then.get(name) != now.get(name))


def mixed_modules(tags: Iterable[str | None]) -> list[str]:
    """Return the names of modules of which some runs have loaded different versions.

    Args:
        tags: Checksums of each run, as `as_tag` wrote them; None if a run has none.
    """
    versions: dict[str, set[str]] = {}
    for tag in tags:
        for name, each in _sums_in(tag or "").items():
            versions.setdefault(name, set()).add(each)
    return sorted(name for name, sums in versions.items() if len(sums) > 1)


def as_tag(sums: Mapping[str, str]) -> str:
    """Return checksums as the text of a tag."""
    return " ".join(f"{name}:{each}" for name, each in sums.items())


def _sums_in(tag: str) -> dict[str, str]:
    return dict(each.rpartition(":")[::2] for each in tag.split())


def _modules_of(target: str) -> Iterator[str]:
    """Yield the module of a class, once it is imported."""
    # What cannot be imported is reported where it is built.
    try:
        module = getattr(get_object(target), "__module__", None)
    except Exception:
        return
    if isinstance(module, str):
        yield from _with_parents(module)


def _with_parents(name: str) -> Iterator[str]:
    parts = name.split(".")
    yield from (".".join(parts[: n + 1]) for n in range(len(parts)))


def _own_file(module: ModuleType) -> Path | None:
    """Return the source file of a module; None if it is armscan's, installed, or not a file, as in an archive."""
    path = Path(getattr(module, "__file__", None) or "")
    if path.suffix != ".py" or not path.is_file() or module.__name__.partition(".")[0] == "armscan":
        return None
    is_installed = PACKAGE_FOLDERS & {*path.parts} or any(path.is_relative_to(folder) for folder in INSTALLED)
    return None if is_installed else path


@functools.cache
def _read(module: ModuleType, file: Path) -> tuple[str, tuple[str, ...]]:
    """Return a checksum of a module, and the names of what it imports; read once, because loaded code stays."""
    source = file.read_bytes()
    return sha256(source)[:N_CHARS], tuple(_imported(module, source))


def _imported(module: ModuleType, source: bytes) -> Iterator[str]:
    nodes: list[ast.AST] = [ast.parse(source)]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Import):
            for each in node.names:
                yield from _with_parents(each.name)
        elif isinstance(node, ast.ImportFrom):
            try:
                base = importlib.util.resolve_name("." * node.level + (node.module or ""), module.__package__)
            # The module catches it, too, as one that is also a script.
            except ImportError:
                continue
            yield from _with_parents(base)
            yield from (f"{base}.{each.name}" for each in node.names)
        elif not _is_left_out(node):
            nodes += ast.iter_child_nodes(node)


def _is_left_out(node: ast.AST) -> bool:
    """Return whether a statement is not executed when its module is loaded."""
    is_for_types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
    return is_for_types or isinstance(node, FUNCTIONS)
