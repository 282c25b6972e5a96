"""A user's mistake, answered in one line that names what is allowed."""

from __future__ import annotations

import logging
import re
import sys
import warnings
from collections.abc import Sequence

from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    InstantiationException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, MissingMandatoryValue, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationResolutionError,
    OmegaConfBaseException,
)
from yaml import YAMLError

from armscan.config.choices import choices
from armscan.config.compose import compose
from armscan.config.legacy import rename_hint
from armscan.errors import ArmscanError, listed

OURS_IN_A_RESOLVER = re.compile(r"InvalidValueError raised while resolving interpolation: (.*)")


def one_line_message(error: BaseException, words: Sequence[str] | None = None) -> str | None:
    """Return what a user did wrong and what is allowed instead; None where the error is no user's mistake.

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
            return _composition_mistake(error)
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
            return f"{emptied} is None, but it must be {listed(choices()[emptied])}"
        case ValueError() if _is_raised_by_hydra(error):
            return " ".join(str(error).split())
        case YAMLError() | UnicodeDecodeError():
            return f"a file of the configuration cannot be read: {' '.join(str(error).split())}"
        case OSError() if error.filename is not None:
            return f"{error.filename}: {error.strerror}"
    return None


def silence_library_warnings() -> None:
    """Keep warnings of libraries that a user can do nothing about off the screen."""
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


def _composition_mistake(error: ConfigCompositionException) -> str:
    if isinstance(cause := error.__cause__, ConfigAttributeError | ConfigKeyError):
        return _unknown_key(cause)
    text = " ".join(str(error).split())
    if ambiguous := re.match(r"Ambiguous value for argument '(.*?)'", text):
        return (
            f"{ambiguous.group(1)} gives several values, which needs -m: python -m armscan.run -m {ambiguous.group(1)}"
        )
    return text


def _unknown_key(error: ConfigAttributeError | ConfigKeyError) -> str:
    if hint := rename_hint(str(error.full_key)):
        return hint
    parent = str(error.full_key).rpartition(".")[0]
    return _no_key(str(error.key), f"in {parent}" if parent else "at the top", _keys_of(error.parent_node))


def _no_key(key: str, where: str, allowed: Sequence[str]) -> str:
    return f"there is no key {key!r} {where}" + (f", but only {listed(allowed)}" if allowed else "")


def _keys_of(node: object) -> list[str]:
    """Return the keys of a section that a user may set; none where it is no section."""
    keys = [str(key) for key in node] if isinstance(node, DictConfig) else []
    return [key for key in keys if not key.startswith("_") and key != "hydra"]


def _instantiation_mistake(error: InstantiationException, words: Sequence[str]) -> str:
    text = " ".join(str(error).split())
    if unexpected := re.search(r"unexpected keyword argument '(\w+)'.*full_key: (\S+)", text):
        key, parent = unexpected.groups()
        if hint := rename_hint(f"{parent}.{key}"):
            return hint
        chosen = [word for group, names in choices().items() for name in names if (word := f"{group}={name}") in words]
        allowed = _keys_of(OmegaConf.select(compose(chosen), parent))
        if key in allowed and any(re.match(r"[a-z_/]+=\[", word) for word in words):
            # The last of several choices gives the class, and all of them its arguments.
            return (
                f"{parent} is put together from several choices, of which the last has no key {key!r}: choose one, or "
                "name several observations to be merged, as in env.observation=[cluster,slice]"
            )
        if key in allowed:
            # Words that choose groups give it to those that have no place for it: a preset does.
            return f"experiment sets {parent}.{key}, but the {parent} that is chosen beside it has no such value"
        return _no_key(key, f"in {parent}", allowed)
    return f"{text} (HYDRA_FULL_ERROR=1 shows where)"


def _emptied_group(words: Sequence[str]) -> str | None:
    """Return the group that was given as null in these words, if one was."""
    groups = (word.removesuffix("=null") for word in words if word.endswith("=null"))
    return next((group for group in groups if group in choices()), None)
