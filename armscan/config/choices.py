"""The choices of each configuration group, and the help that names them."""

from __future__ import annotations

import textwrap
from pathlib import Path

from omegaconf import OmegaConf

from armscan.config.sources import CONF, SWEEP, SWEEPS, config_folder, own_folders, sweeps_folder, yaml_files

# Groups that other configurations choose from, not users.
HIDDEN = ("hydra/help", "study")
MAX_CHARS = 100


def choices() -> dict[str, dict[str, Path]]:
    """Return the file of each choice, by group and name; the user's files replace those of the same name."""
    own = own_folders()
    roots = [(config_folder(), ""), (own.get(CONF), ""), (sweeps_folder(), SWEEP), (own.get(SWEEPS), SWEEP)]
    found: dict[str, dict[str, Path]] = {}
    for root, prefix in roots:
        for path in yaml_files(root) if root is not None else ():
            name = path.relative_to(root).with_suffix("") if root is not None else path
            # Studies in a subfolder are choices of the same group: sweep=FOLDER/NAME.
            group, choice = (prefix, name.as_posix()) if prefix else (name.parent.as_posix(), name.name)
            found.setdefault(group, {})[choice] = path
    return dict(sorted(found.items()))


def summary(path: Path) -> str:
    """Return the first sentence of a file's leading comment, cut to 100 characters."""
    lines = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @"):
            lines.append(line.removeprefix("#").strip())
    sentence = " ".join(lines).partition(". ")[0].removesuffix(".")
    return textwrap.shorten(sentence, MAX_CHARS, placeholder=" ...")


def choices_help() -> str:
    """Return all groups with their choices, one line each."""
    parts = []
    for group, files in choices().items():
        if group not in (".", *HIDDEN):
            width = max(map(len, files)) + 2
            parts += [f"{group}=", *(f"  {name:{width}}{summary(path)}".rstrip() for name, path in files.items()), ""]
    # Hydra substitutes names that follow a dollar sign.
    return "\n".join(parts).replace("$", "$$")


OmegaConf.register_new_resolver("armscan.choices", choices_help, replace=True)
