"""A user's mistake, answered in one line that names what is allowed."""

from __future__ import annotations

import logging
import re
import sys
import warnings
from collections.abc import Sequence
from importlib import resources

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    InstantiationException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, MissingMandatoryValue, OmegaConf
from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException
from yaml import YAMLError

from armscan.errors import ArmscanError, listed

CONFIG_MODULE, CONFIG_NAME = "armscan.conf", "config"
GROUP = re.compile(r"[a-z_/]+")
OURS_IN_A_RESOLVER = re.compile(r"InvalidValueError raised while resolving interpolation: (.*)")


def mistake_in_one_line(error: BaseException, words: Sequence[str] | None = None) -> str | None:
    """Returns what a user did wrong and what is allowed instead; None where the error is no user's mistake.

    Args:
        error: whatever was raised.
        words: that the configuration was composed of; those of the command line where they are None.
    """
    words = sys.argv[1:] if words is None else words
    ours = next((cause for cause in _causes(error) if isinstance(cause, ArmscanError)), None)
    if ours is not None:
        return str(ours)
    match error:
        case MissingConfigException(options=options) if options:
            group, _, choice = str(error.missing_cfg_file).rpartition("/")
            return f"{group} is {choice!r}, but it must be {listed(options)}"
        case ConfigCompositionException():
            return _composition_mistake(error, words)
        case OverrideParseException():
            return f"{error.override!r} cannot be read: what follows the options must be key=value"
        case MissingMandatoryValue():
            return f"{error.full_key} is not set, but it must be: give {error.full_key}=VALUE"
        case InstantiationException():
            return _instantiation_mistake(error, words)
        case InterpolationResolutionError() if said := OURS_IN_A_RESOLVER.match(str(error)):
            # Of an error that a resolver raises, OmegaConf keeps nothing but the text.
            return said[1]
        case HydraException() | OmegaConfBaseException():
            return " ".join(str(error).split())
        case ValueError() if _is_raised_by_hydra(error) and (emptied := _emptied_group(words)):
            return f"{emptied} is None, but it must be {listed(_choices_of(emptied))}"
        case ValueError() if _is_raised_by_hydra(error):
            return " ".join(str(error).split())
        case YAMLError() | UnicodeDecodeError():
            return f"a file of the configuration cannot be read: {' '.join(str(error).split())}"
        case OSError() if error.filename is not None:
            return f"{error.filename}: {error.strerror}"
    return None


def quieten_libraries() -> None:
    """Keeps warnings of libraries that a user can do nothing about off the screen."""
    for message in (
        "Gym has been unmaintained",
        ".*is an experimental feature.*",
        ".*Deprecat.*",
        ".*is not divisible by the number of test environments.*",
        # Our values of a launcher are checked against the launcher's own, as they should be.
        r"\s*'hydra/launcher/.*' is validated against ConfigStore schema",
    ):
        warnings.filterwarnings("ignore", message=message)
    for category in (DeprecationWarning, FutureWarning, PendingDeprecationWarning):
        warnings.filterwarnings("ignore", category=category)
    # What Hydra tells of a class that is not there is in the error, too.
    logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)
    logging.getLogger("tianshou").setLevel(logging.ERROR)
    logging.getLogger("sensai").setLevel(logging.ERROR)


def _causes(error: BaseException | None) -> list[BaseException]:
    causes = []
    while error is not None:
        causes.append(error)
        error = error.__cause__
    return causes


def _is_raised_by_hydra(error: BaseException) -> bool:
    """Whether Hydra itself raised it, as it does for an override like `obs=null`."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and str(trace.tb_frame.f_globals.get("__name__")).startswith("hydra.")


def _composition_mistake(error: ConfigCompositionException, words: Sequence[str]) -> str:
    text = " ".join(str(error).split())
    if ambiguous := re.match(r"Ambiguous value for argument '(.*?)'", text):
        return (
            f"{ambiguous.group(1)} gives several values, which needs -m: python -m armscan.run -m {ambiguous.group(1)}"
        )
    if unknown := re.match(r"Could not override '(.*?)'", text):
        parent, _, name = unknown.group(1).rpartition(".")
        # Its parent may not be there either.
        while not (allowed := _keys_under(parent, words)) and parent:
            parent, _, name = parent.rpartition(".")
        where = f"in {parent}" if parent else "at the top"
        return f"there is no key {name!r} {where}" + (f", but only {listed(allowed)}" if allowed else "")
    return text


def _instantiation_mistake(error: InstantiationException, words: Sequence[str]) -> str:
    text = " ".join(str(error).split())
    if unexpected := re.search(r"unexpected keyword argument '(\w+)'.*full_key: (\S+)", text):
        key, parent = unexpected.groups()
        allowed = _keys_under(parent, words)
        if key in allowed and any(re.match(r"[a-z_/]+=\[", word) for word in words):
            # The last of several choices gives the class, and all of them its arguments.
            return (
                f"{parent} is put together from several choices, of which the last has no key {key!r}: choose one, or "
                "name several observations to be merged, as in env.observation=[cluster,slice]"
            )
        if key in allowed:
            # Words that choose groups give it to those that have no place for it: a preset does.
            return f"experiment sets {parent}.{key}, but the {parent} that is chosen beside it has no such value"
        return f"there is no key {key!r} in {parent}" + (f", but only {listed(allowed)}" if allowed else "")
    return f"{text} (HYDRA_FULL_ERROR=1 shows where)"


def _emptied_group(words: Sequence[str]) -> str | None:
    """The group that was given as null in these words, if one was."""
    groups = (word.removesuffix("=null") for word in words if word.endswith("=null"))
    return next((group for group in groups if GROUP.fullmatch(group) and _choices_of(group)), None)


def _choices_of(group: str) -> list[str]:
    """The choices of a group of the configuration, none where there is no such group."""
    folder = resources.files(CONFIG_MODULE) / group
    files = folder.iterdir() if folder.is_dir() else ()
    return sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml"))


def _keys_under(parent: str, words: Sequence[str]) -> list[str]:
    """The keys that the configuration has under a parent, with the groups chosen as by these words."""
    choices = [word for word in words if re.fullmatch(r"[a-z_/]+=[a-z_0-9]+", word)]
    GlobalHydra.instance().clear()
    for overrides in (choices, []):
        try:
            with initialize_config_module(CONFIG_MODULE, version_base="1.3"):
                node = (
                    OmegaConf.select(compose(CONFIG_NAME, overrides), parent)
                    if parent
                    else compose(CONFIG_NAME, overrides)
                )
        except (HydraException, OmegaConfBaseException):
            continue
        return [str(key) for key in node if not str(key).startswith("_")] if isinstance(node, DictConfig) else []
    return []
