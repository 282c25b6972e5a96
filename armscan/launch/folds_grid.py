"""Cross-validation: `data.folds` on the command line, or in the experiment that it names, makes a grid of the folds."""

from __future__ import annotations

from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from armscan.config.compose import compose
from armscan.config.defaults import FOLD, FOLDS, MULTIRUN
from armscan.errors import InvalidValueError

# What may set `data.folds`.
MAY_SET_FOLDS = (f"{FOLDS}=", "experiment=")


def with_folds(arguments: Sequence[str]) -> list[str]:
    """Return the arguments of a command line, as a grid over the folds if they ask for folds.

    Other keys that the grid varies, such as `seed=0,1,2`, stay.

    Raises:
        InvalidValueError: If the folds are not allowed or vary, or `data.path` or `data.test` contradicts them.
        ArmscanError: If the folder of the volumes cannot be read.
    """
    overrides = [each for each in arguments if not each.startswith("-")]
    options = [each for each in arguments if each.startswith("-")]
    if set(options) - set(MULTIRUN) or not any(each.lstrip("+").startswith(MAY_SET_FOLDS) for each in overrides):
        return list(arguments)
    try:
        parsed = OverridesParser.create().parse_overrides(overrides)
        # Overrides that the grid varies are left out: they do not set its folds.
        data = compose([each.input_line for each in parsed if each.input_line and not each.is_sweep_override()]).data
        folds, fold, path = data.get("folds"), data.get("fold"), data.get("path")
        n_volumes = data.get("n_volumes")
    # Hydra or the run reports it.
    except (HydraException, OmegaConfBaseException):
        return list(arguments)
    if fold is not None or any(each.key_or_group == FOLD for each in parsed):
        return list(arguments)
    if any(each.key_or_group == FOLDS and each.is_sweep_override() for each in parsed):
        raise InvalidValueError(f"{FOLDS} has several values, but all jobs of a grid share one: start a grid for each")
    if folds is None:
        return list(arguments)
    # Deferred: command-line errors are reported before these are loaded.
    from armscan.training.subject_splits import check_folds, n_folds
    from armscan.volumes.dataset import subjects_in

    if path is None:
        raise InvalidValueError("data.path is not set, but it must be: give data.path=VALUE")
    check_folds(folds, data.get("test"))
    count = n_folds(folds, len(set(subjects_in(path, n_volumes))))
    return [MULTIRUN[0], *overrides, f"{FOLD}={','.join(map(str, range(count)))}"]
