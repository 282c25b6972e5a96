"""Compose the configuration; `./conf` and `./sweeps` of the working folder take precedence over armscan's own."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import hydra
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_loader import ConfigLoader
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.utils import instantiate
from omegaconf import DictConfig, open_dict

# Imported to register the resolvers that the configuration uses.
from armscan.config import choices as choices
from armscan.config import services as services
from armscan.config.defaults import CLUSTER, to_plain
from armscan.config.sources import (
    CONF,
    CONFIG_NAME,
    SWEEP,
    SWEEPS,
    config_folder,
    own_folders,
    replaced_files,
    sweeps_folder,
    yaml_files,
)
from armscan.errors import InvalidValueError, few

T = TypeVar("T")
VERSION_BASE = "1.3"
MAX_NAMED = 3


class SweepsSource(FileConfigSource):
    """A folder of studies as the configuration group `sweep`."""

    @staticmethod
    def scheme() -> str:
        """Return the scheme of its addresses."""
        return SWEEPS

    def is_group(self, config_path: str) -> bool:
        """Return whether this is the group, or the folder that it is in."""
        return config_path in ("", SWEEP)

    def is_config(self, config_path: str) -> bool:
        """Return whether this is a study of the folder."""
        group, _, name = config_path.partition("/")
        return group == SWEEP and bool(name) and super().is_config(name)

    def load_config(self, config_path: str) -> ConfigResult:
        """Read a study."""
        return super().load_config(config_path.removeprefix(f"{SWEEP}/"))

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """Return the studies of the folder; for a parent of the folder, the group."""
        if not config_path:
            return [] if results_filter == ObjectType.CONFIG else [SWEEP]
        folder = Path(self.path)
        names = [path.relative_to(folder).with_suffix("").as_posix() for path in yaml_files(folder)]
        return [] if results_filter == ObjectType.GROUP else names


class OwnFolders(SearchPathPlugin):
    """Add armscan's studies, and search the folders of the working folder before armscan's own."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Add the folders, if the application is armscan."""
        if any(each.path == str(config_folder()) for each in search_path.get_path()):
            search_path.append(SWEEPS, f"{SWEEPS}://{sweeps_folder()}")
            for name, folder in own_folders().items():
                scheme = "file" if name == CONF else SWEEPS
                search_path.prepend(f"./{name}", f"{scheme}://{folder}", anchor="main")
            _print_replaced(tuple(f"./{path}" for path in replaced_files()))


@functools.cache
def _print_replaced(names: tuple[str, ...]) -> None:
    """Print once which of armscan's own files are not used."""
    if names:
        print(f"using {few(names, MAX_NAMED)} instead of armscan's own", file=sys.stderr)


@functools.cache
def register() -> None:
    """Register both plugins with Hydra in this process."""
    for plugin in (SweepsSource, OwnFolders):
        Plugins.instance().register(plugin)


def application(run: Callable[[DictConfig], None]) -> Callable[[], None]:
    """Wrap a function as a Hydra application that reads `sys.argv`."""
    register()
    main: Callable[[], None] = hydra.main(str(config_folder()), CONFIG_NAME, VERSION_BASE)(run)
    return main


def compose(overrides: Sequence[str] = (), *, return_hydra_config: bool = False) -> DictConfig:
    """Return the configuration that `armscan run` composes from these overrides.

    Args:
        overrides: Overrides in the syntax of the command line, such as `["agent=ppo", "seed=1"]`.
        return_hydra_config: Whether to keep the section `hydra`. Default: False.
    """
    with config_loader():
        return hydra.compose(CONFIG_NAME, list(overrides), return_hydra_config=return_hydra_config)


@contextmanager
def config_loader() -> Iterator[ConfigLoader]:
    """Yield a loader of armscan's configuration and the user's own, which Hydra uses meanwhile."""
    register()
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(config_folder()), version_base=VERSION_BASE):
        yield GlobalHydra.instance().config_loader()


def compose_run(overrides: Sequence[str]) -> tuple[DictConfig, dict[str, str]]:
    """Return the configuration of a run, without the section of a study, and the choice of each group."""
    return reduce_to_run(compose(overrides, return_hydra_config=True))


def reduce_to_run(config: DictConfig) -> tuple[DictConfig, dict[str, str]]:
    """Remove from a composed configuration what does not describe a run; return it, and the choice of each group."""
    choices = {str(group): str(choice) for group, choice in config.hydra.runtime.choices.items()}
    with open_dict(config):
        # Resolved first: its address may come from the section `cluster`, which is removed.
        config.tracking = to_plain(config.tracking)
        for section in ("study", "hydra", CLUSTER):
            config.pop(section, None)
    return config, choices


def build_section(config: DictConfig, section: str, kind: type[T]) -> T:
    """Build the object of a section of a configuration.

    Args:
        config: Configuration.
        section: Key of the section.
        kind: Class of the object.

    Raises:
        InvalidValueError: If the section builds an object of another class.
    """
    built = instantiate(config[section], _convert_="object")
    if not isinstance(built, kind):
        raise InvalidValueError(f"{section} builds {built!r}, but it must build a {kind.__name__}")
    return built
