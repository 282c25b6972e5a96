"""One-line messages for users' mistakes, with the allowed values."""

from __future__ import annotations

import os
import re
import traceback

from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    InstantiationException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, MissingMandatoryValue
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException
from yaml import YAMLError

from armscan.config.legacy import rename_hint
from armscan.errors import ArmscanError, in_one_line, listed, print_error
from armscan.utils.files import FULL_DISK

TRACEBACKS = "ARMSCAN_TRACEBACKS"
# Characters of lists, dictionaries, functions and quoted strings in Hydra's overrides.
PARTS_OF_VALUES = frozenset("[]{}()'\"")
# Modules that read configurations, and Python's own that decode text.
OF_CONFIGURATION, DECODING = ("hydra.", "omegaconf.", "yaml."), ("codecs", "encodings.utf_8")
# Keys of a folder of volumes, which phantoms do not have.
OF_FOLDER = ("data.path", "data.folds", "data.fold", "data.validation", "data.test")


def print_mistake(error: BaseException) -> bool:
    """Print a user's mistake in one line; return False for any other error, or if the user wants tracebacks."""
    line = one_line_message(error)
    if line is None or os.environ.get(TRACEBACKS):
        return False
    print_error(line)
    return True


def one_line_message(error: BaseException) -> str | None:
    """Return a user's mistake and the allowed values in one line; None if the error is not a user's mistake."""
    text = in_one_line(error)
    if (ours := _armscan_error(error)) is not None:
        _, found, section = text.rpartition("full_key: ")
        return _named(str(ours), section) if found else str(ours)
    match error:
        case MissingConfigException(options=options) if options:
            group, _, choice = str(error.missing_cfg_file).rpartition("/")
            return f"{group} is {choice!r}, but it must be {listed(options)}"
        case ConfigCompositionException(__cause__=ConfigAttributeError() | ConfigKeyError() as unknown):
            return _unknown_key(unknown)
        case HydraException() if several := re.match("Ambiguous value for argument '(.*?)' 1", text):
            return f"{several[1]!r} gives several values: armscan run -m tries each of them; a list is KEY=[A,B]"
        case OverrideParseException():
            if given := re.fullmatch(r"([+~]*[\w./@:-]+)=(.*)", str(error.override), re.DOTALL):
                key, value = given.groups()
                has_parts = not PARTS_OF_VALUES.isdisjoint(value)
                advice = f"quote strings in it: {key}=\"['a b']\"" if has_parts else f"quote it: {key}=\"'{value}'\""
                return f"the value of {key} cannot be read: {value}; {advice}"
            return f"{error.override!r} cannot be read: what follows the options must be key=value"
        case MissingMandatoryValue():
            return f"{error.full_key} is not set, but it must be: give {error.full_key}=VALUE"
        case InstantiationException(__cause__=ImportError(__cause__=Exception() as failed)):
            return f"{text.rpartition('full_key: ')[2]}._target_ cannot be imported: {_why_not_imported(failed)}"
        case HydraException() | OmegaConfBaseException():
            return text
        case UnicodeDecodeError():
            what = "a file of the configuration" if _module_of(error).startswith(OF_CONFIGURATION) else "a file"
            return f"{what} cannot be read: {text}"
        # Raised by Hydra for an override such as obs=null.
        case ValueError() if _module_of(error).startswith("hydra."):
            return text
        case YAMLError():
            return f"a file of the configuration cannot be read: {text}"
        case OSError() if error.filename is not None:
            return f"{error.filename}: {error.strerror}"
        case OSError() if error.errno in FULL_DISK:
            return f"a file cannot be written: {error.strerror}"
    return None


def _why_not_imported(error: Exception) -> str:
    if not isinstance(error, ImportError):
        return f"{type(error).__name__}: {in_one_line(error)}"
    module, _, name = str(error.name).rpartition(".")
    if f"{module!r} is not a package" in str(error):
        return f"{module} has no {name}"
    return f"{error}; it must be in the current folder, or installed"


def _named(message: str, section: str) -> str:
    """Return a message whose keys name the section that they were read from, `agent.sac.` or `network.vector.`."""
    _, of_network, part = section.partition("network.")
    if of_network:
        return message.replace(of_network, f"{of_network}{part}.")
    return message.replace("agent.", f"{section}.") if section.startswith("agent.") else message


def _armscan_error(error: BaseException | None) -> ArmscanError | None:
    """Return the first error of armscan in a chain of causes; None if there is none."""
    while error is not None and not isinstance(error, ArmscanError):
        # OmegaConf sets only the context of an error that a resolver has raised, not its cause.
        error = error.__context__ if isinstance(error, OmegaConfBaseException) else error.__cause__
    return error


def _module_of(error: BaseException) -> str:
    """Return the name of the module that raised an error; empty if nothing raised it in this process."""
    modules = [str(frame.f_globals.get("__name__")) for frame, _ in traceback.walk_tb(error.__traceback__)]
    # An error from another process has no frames; text is decoded by Python's own modules.
    return next((each for each in reversed(modules) if each not in DECODING), "")


def _unknown_key(error: ConfigAttributeError | ConfigKeyError) -> str:
    if hint := rename_hint(str(error.full_key)):
        return hint
    parent, node = str(error.full_key).rpartition(".")[0], error.parent_node
    keys = [str(key) for key in node] if isinstance(node, DictConfig) else []
    allowed = [key for key in keys if not key.startswith("_") and key != "hydra"]
    only = f", but only {listed(allowed)}" if allowed else ""
    if error.full_key in OF_FOLDER:
        only += f": {error.full_key} needs data=nifti or data=mixed"
    return f"there is no key {str(error.key)!r} {f'in {parent}' if parent else 'at the top'}{only}"
