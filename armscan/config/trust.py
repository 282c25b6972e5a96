"""Code that a stored configuration or command line may execute.

Hydra builds objects by the names of their classes, so a configuration is a program. What this user typed is trusted.
What comes from a store or a run's folder may be anybody's: without `--trust`, only armscan's own classes are built from
it, and interpolations are refused.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from armscan.config.legacy import migrate
from armscan.config.sources import SWEEP, config_folder, own_folders, sweeps_folder, yaml_files
from armscan.errors import UntrustedError

TRUST = "--trust"
HOW = f"if you trust its author, repeat the command with {TRUST}"
TARGET, INTERPOLATION = "_target_", "${"
TARGETS = re.compile(rf"""{TARGET}["']?: *["']?([\w.]+)""")
SERVER = re.compile(r"(?<![\w+.-])(?!sqlite:)[\w+.-]+://")
# A path that leads out of a group of the configuration: Hydra composes any YAML file that the choice of a group names.
OUTSIDE = re.compile(r"\.\.|(?<![\w-])/")
# Schemes of artifacts whose clients send no password to a server of anybody's: object stores, a path, a folder.
OBJECT_STORES = ("s3", "gs", "wasbs")
# Functions that may write phantoms.
OF_DATA = tuple(f"armscan.training.{name}_data" for name in ("phantom", "nifti", "mixed"))
# Keys of Hydra that armscan's configuration does not use.
UNUSED = frozenset({"_args_", "_partial_", "_convert_", "_recursive_"})
AMBIGUOUS = frozenset("\\ ")
WITHOUT_PASSWORD = (*OBJECT_STORES, "", "file")
# Of grids and studies; the configuration of a run names none of their classes.
GROUPS_OF_COMMANDS = ("hydra", "study")
PACKAGES_OF_COMMANDS = ("armscan.launch.", "armscan.sweeps.")


@functools.cache
def offered_classes() -> frozenset[str]:
    """Return the names of the classes and functions that armscan's own configuration builds runs from."""
    root = config_folder()
    files = [path for path in yaml_files(root) if path.relative_to(root).parts[0] not in GROUPS_OF_COMMANDS]
    names = _classes_in([*files, *yaml_files(sweeps_folder())])
    return frozenset(name for name in names if not name.startswith(PACKAGES_OF_COMMANDS))


def _classes_in(files: Iterable[Path]) -> set[str]:
    return {name for file in files for name in TARGETS.findall(file.read_text(encoding="utf-8"))}


def stored_config(config: Mapping[str, Any], *, where: str, trust: bool) -> dict[str, Any]:
    """Return a stored configuration with the keys and classes of this version.

    Args:
        config: Resolved configuration, as it was stored.
        where: Owner of the configuration, such as `run 3bf2`, for the error.
        trust: Whether to keep foreign classes, interpolations and its `data.cache_dir` (`--trust`). Otherwise the
            user's own cache is used.

    Raises:
        UntrustedError: If it names a class that armscan does not offer, holds an interpolation, or could write phantoms
            into a folder that it names.
    """
    config = migrate(config)
    if trust:
        return config
    if found := _foreign_part(config, offered_classes()) or _misplaced_part(config):
        raise UntrustedError(f"{where}: its configuration {found}; {HOW}")
    data = config.get("data")
    # Phantoms would be written into any folder; the user's own cache holds the same ones.
    return config | {"data": {**data, "cache_dir": None}} if isinstance(data, dict) and "cache_dir" in data else config


def _misplaced_part(config: Mapping[str, Any]) -> str | None:
    """Return the part of a configuration that could write phantoms into any folder; None if there is none.

    Only `data` makes volumes, and by named arguments.
    """
    for key, value in _leaves(config):
        parts = key.split(".")
        if not UNUSED.isdisjoint(parts):
            return f"has {key}, which armscan's own configuration uses nowhere"
        is_of_data = parts[-1] == "cache_dir" or (parts[-1] == TARGET and value in OF_DATA)
        if is_of_data and parts[:-1] != ["data"]:
            return f"has {key}={value!r}, but this is allowed only in the section data"
    return None


def check_composed(config: Mapping[str, Any], *, where: str) -> None:
    """Raise `UntrustedError` if a configuration, composed from stored overrides, names a class that no file here names.

    The files are armscan's own, and those in `./conf` and `./sweeps` of the working folder.

    Args:
        config: Resolved configuration.
        where: Owner of the configuration, such as `job 3`, for the error.
    """
    own = _classes_in(file for folder in own_folders().values() for file in yaml_files(folder))
    if found := _foreign_part(config, offered_classes() | own):
        raise UntrustedError(f"{where}: its configuration {found}; {HOW}")


def classes_in_groups(choices: Mapping[str, Iterable[object]]) -> set[str]:
    """Return the names of the classes in the user's own files of these choices, by configuration group."""
    folders = own_folders().values()
    files = (folder / group / f"{each}.yaml" for folder in folders for group in choices for each in choices[group])
    return _classes_in(filter(Path.is_file, files))


def foreign_targets(config: Mapping[str, Any]) -> list[str]:
    """Return the names of the classes and functions in a configuration that are not armscan's."""
    targets = (str(value) for key, value in _leaves(config) if key.rpartition(".")[2] == TARGET)
    return [each for each in dict.fromkeys(targets) if each not in offered_classes()]


def needs_trust(config: Mapping[str, Any]) -> bool:
    """Return whether a run with this configuration, or these MLflow parameters, can be built only with `--trust`."""
    return _foreign_part(migrate(config), offered_classes()) is not None


def _foreign_part(config: Mapping[str, Any], allowed: Collection[str]) -> str | None:
    """Return the part of a configuration that builds anything but these classes; None if there is none."""
    for key, value in _leaves(config):
        if key.rpartition(".")[2] == TARGET and str(value) not in allowed:
            return (
                f"builds {key.removesuffix(f'.{TARGET}')} by {value!r}, which is none of armscan's classes and would "
                "execute code of others"
            )
        if isinstance(value, str) and INTERPOLATION in value:
            return (
                f"has {key}={value!r}, but a stored value holds no interpolation, which could read this machine's "
                "environment"
            )
    return None


def untrusted_override(overrides: Sequence[str], uri: str) -> str | None:
    """Return the first override of a command line that could execute code, or send results elsewhere; None if none.

    Args:
        overrides: Overrides of a command line.
        uri: Address of the store that keeps them.
    """
    for override in overrides:
        # Hydra removes the backslash of an escaped colon or brace.
        plain = override.replace("\\", "")
        key, _, value = plain.lstrip("+~").partition("=")
        # Hydra also accepts a quoted value.
        value = value.strip("'\"")
        # A server is sent this user's password.
        is_elsewhere = value.rstrip("/") != uri.rstrip("/") and SERVER.search(value) is not None
        is_changing_hydra = "hydra" in key or key.startswith("-") or key.partition("@")[0] == SWEEP
        # A key with dots is a value, which may be any path, and never a group.
        is_outside = "." not in key.partition("@")[0] and OUTSIDE.search(value) is not None
        if is_elsewhere or is_changing_hydra or is_outside or TARGET in plain or INTERPOLATION in plain:
            return override
    return None


def check_stored_overrides(overrides: Sequence[str], uri: str, *, where: str) -> None:
    """Raise `UntrustedError` if a stored command line could execute code, or send results elsewhere.

    Args:
        overrides: Overrides of a command line.
        uri: Address of the store that they were read from.
        where: Owner of the command line, such as `run 3bf2`, for the error.
    """
    if (override := untrusted_override(overrides, uri)) is not None:
        raise UntrustedError(
            f"{where}: its command line has {override!r}, which could execute code of others or send results "
            f"elsewhere; {HOW}"
        )


def check_stored_address(uri: str, own: Collection[str]) -> None:
    """Raise `UntrustedError` if a stored address is that of a store which is not known as this user's.

    Clients find passwords in many places, such as the environment, its files, `~/.pgpass` and `~/.mlflow/credentials`,
    and send them to the server that they are told to use. A database says in which folders artifacts are written.

    Args:
        uri: Address of a tracking store, as a folder or a store names it.
        own: Addresses of this user's stores.
    """
    if uri.rstrip("/") not in (each.rstrip("/") for each in own):
        raise UntrustedError(
            f"{uri} is neither the default store nor one that a run of this user is pending in: it could be sent this "
            f"user's passwords, or have files written anywhere; give --tracking {uri} if it is yours"
        )


def check_artifact_address(uri: str, store: str) -> None:
    """Raise `UntrustedError` if artifacts are on a server that could be sent this user's password for another.

    MLflow sends the password of its tracking server to each address over HTTP that a run or an experiment names.

    Args:
        uri: Address of the artifacts of a run, or of an experiment.
        store: Address of the tracking store that names it.
    """
    scheme, host = _server_of(uri)
    of_store, own = _server_of(store)
    # Without a server of its own, `mlflow-artifacts:/...` is on the store's.
    is_named = host == own if scheme == of_store else scheme == "mlflow-artifacts" and host in ("", own)
    is_here = of_store in ("http", "https") and is_named
    if scheme not in WITHOUT_PASSWORD and not is_here:
        raise UntrustedError(
            f"the artifacts are in {uri}, but those of the store {store} must be in a folder, in an object store "
            f"({', '.join(OBJECT_STORES)}), or on its own server: another would be sent this user's password"
        )


def _server_of(uri: str) -> tuple[str, str]:
    """Return the scheme of an address, and its server: host and port, without a user; `unknown` if it has no form."""
    authority = re.split("[/?#]", uri.partition("://")[2], maxsplit=1)[0]
    # Clients disagree on the server of `http://one\@other`.
    if not AMBIGUOUS.isdisjoint(authority) or not uri.isprintable():
        return "unknown", "unknown"
    try:
        parts = urlsplit(uri)
        port = parts.port
    except ValueError:
        return "unknown", "unknown"
    if not parts.hostname:
        return parts.scheme, ""
    return parts.scheme, f"{parts.hostname}:{port or {'https': 443}.get(parts.scheme, 80)}"


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Iterate over all keys of mappings and items of sequences, at any depth, with their values."""
    if isinstance(value, Mapping):
        items: Iterable[tuple[Any, Any]] = value.items()
    elif isinstance(value, list | tuple):
        items = enumerate(value)
    else:
        return
    for key, each in items:
        name = f"{path}.{key}" if path else str(key)
        yield name, each
        yield from _leaves(each, name)
