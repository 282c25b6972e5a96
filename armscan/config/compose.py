"""Compose the configuration, for the command line and outside of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

# They register the resolvers that the configuration uses.
from armscan.config import choices as choices
from armscan.config import services as services
from armscan.config.search_path import register
from armscan.config.sources import CONFIG_NAME, config_folder

VERSION_BASE = "1.3"


def application(run: Callable[[DictConfig], None]) -> Callable[[], None]:
    """Return a function as Hydra's application, which reads `sys.argv`."""
    register()
    main: Callable[[], None] = hydra.main(str(config_folder()), CONFIG_NAME, VERSION_BASE)(run)
    return main


def compose(overrides: Sequence[str] = (), *, return_hydra_config: bool = False) -> DictConfig:
    """Return the configuration that `python -m armscan.run` composes of these overrides.

    Args:
        overrides: as on the command line.
        return_hydra_config: whether to keep the section `hydra`; default: false.
    """
    register()
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(config_folder()), version_base=VERSION_BASE):
        return hydra.compose(CONFIG_NAME, list(overrides), return_hydra_config=return_hydra_config)
