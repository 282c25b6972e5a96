"""Sources of the configuration: the working folder, which takes precedence, and armscan itself."""

from __future__ import annotations

import os
from pathlib import Path

import armscan

# The folders of a checkout or a working folder, and the configuration group that the second one holds.
CONF, SWEEPS, SWEEP = "conf", "sweeps", "sweep"
CONFIG_NAME = "config"


def _checkout() -> Path | None:
    """Return the checkout that armscan is imported from; None for an installed package."""
    folder = Path(armscan.__file__).resolve().parents[1]
    is_checkout = (folder / "pyproject.toml").is_file() and (folder / CONF / f"{CONFIG_NAME}.yaml").is_file()
    return folder if is_checkout else None


def config_folder() -> Path:
    """Return the folder with armscan's `config.yaml` and groups: of the checkout, or else of the installed package."""
    return (_checkout() or Path(armscan.__file__).resolve().parent) / CONF


def sweeps_folder() -> Path:
    """Return the folder with armscan's studies: `sweeps` of the checkout, or else of the installed package."""
    checkout = _checkout()
    return checkout / SWEEPS if checkout else config_folder() / SWEEP


def working_folder() -> Path:
    """Return the working directory under the name by which the user entered it.

    Other machines may know that name, but not the target of a link or a mount on this machine.
    """
    called = Path(os.environ.get("PWD", ""))
    return called if called.is_absolute() and called.is_dir() and called.samefile(".") else Path.cwd()


def own_folders() -> dict[str, Path]:
    """Return `./conf` and `./sweeps` by name, if they exist; none in armscan's own checkout."""
    here, ours = working_folder(), config_folder()
    folders = {name: here / name for name in (CONF, SWEEPS) if (here / name).is_dir()}
    is_checkout = CONF in folders and folders[CONF].samefile(ours)
    return {} if is_checkout else folders


def yaml_files(folder: Path) -> list[Path]:
    """Return the YAML files of a folder, recursively, without the hidden ones that editors and systems leave."""
    return sorted(path for path in folder.rglob("*.yaml") if not path.name.startswith(".") and path.is_file())


def config_file(name: str) -> Path:
    """Return the file of a configuration by its path in `conf`, such as `tracking/mlflow.yaml`."""
    own = own_folders().get(CONF)
    return own / name if own is not None and (own / name).is_file() else config_folder() / name


def replaced_files() -> list[Path]:
    """Return the user's files that replace armscan's of the same name, except exact copies of them."""
    replaced = []
    for name, folder in own_folders().items():
        ours = sweeps_folder() if name == SWEEPS else config_folder()
        for path in yaml_files(folder):
            other = ours / path.relative_to(folder)
            if other.is_file() and other.read_bytes() != path.read_bytes():
                replaced.append(Path(name, path.relative_to(folder)))
    return replaced
