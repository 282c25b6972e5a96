"""Put `conf/` and `sweeps/` into wheels and source distributions; in a checkout, only files that git tracks."""

import subprocess
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ConfigurationHook(BuildHookInterface):
    """Adds the configuration as `armscan/conf` to wheels, and in its own place to source distributions."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files; an editable install reads them from the checkout."""
        if version == "editable":
            return
        root = Path(self.root)
        is_wheel = self.target_name == "wheel"
        tracked = _tracked(root)
        for path in sorted([*root.glob("conf/**/*.yaml"), *root.glob("sweeps/*.yaml")]):
            name = path.relative_to(root).as_posix()
            is_private = name.startswith("conf/local/") or (tracked is not None and path.resolve() not in tracked)
            if not is_private:
                # An installed package holds the studies as the configuration group `sweep`.
                packaged = f"armscan/{name.replace('sweeps/', 'conf/sweep/', 1)}"
                build_data["force_include"][str(path)] = packaged if is_wheel else name


def _tracked(root: Path) -> set[Path] | None:
    """Return the files that git tracks; None outside a git repository, as in an unpacked source distribution."""
    if not (root / ".git").exists():
        return None
    git = ["git", "-c", f"safe.directory={root}", "-C", str(root), "ls-files", "-z", "conf", "sweeps"]
    names = subprocess.run(git, check=True, capture_output=True, text=True).stdout.split("\0")
    return {(root / name).resolve() for name in names if name}
