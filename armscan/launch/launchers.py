"""Hydra's launchers: what each requires on this machine, and which of its messages are shown."""

from __future__ import annotations

import logging
import os
import shutil
from importlib.util import find_spec

from armscan.config.error_messages import one_line_message
from armscan.errors import ArmscanError, InvalidValueError, reason_of

LAUNCHER = "hydra/launcher"
ON_THIS_MACHINE = ("basic", "joblib", "submitit_local")
# Prefixes of the environment variables of a Slurm job.
OF_A_JOB = ("SLURM_", "SUBMITIT_")
SLURM, RAY = "submitit_slurm", "ray"
# By launcher: the extra of armscan that installs its packages, and their names.
IMPORTED = {
    SLURM: ("slurm", ("submitit", "hydra_plugins.hydra_submitit_launcher")),
    RAY: ("ray", ("ray", "hydra_plugins.hydra_ray_launcher")),
}


def check_launcher(name: str) -> None:
    """Raise `InvalidValueError` if something that a launcher needs is not installed on this machine."""
    extra, packages = IMPORTED.get(name, ("", ()))
    for package in packages:
        if find_spec(package) is None:
            raise InvalidValueError(
                f"{LAUNCHER} is {name!r}, but {package} is not installed: pip install 'armscan[{extra}]'"
            )
    if name == SLURM and shutil.which("sbatch") is None:
        raise InvalidValueError(
            f"{LAUNCHER} is {name!r}, but this machine has no sbatch: start it where Slurm takes jobs"
        )


def launcher_error(name: str, error: Exception) -> ArmscanError:
    """Return an error that names the launcher, for any error that one of its libraries has raised."""
    return ArmscanError(f"{LAUNCHER} is {name!r}, which has failed: {one_line_message(error) or reason_of(error)}")


def prepare_launcher(name: str) -> None:
    """Hide submitit's warnings about missing accounting, and keep this process's Slurm job out of its jobs."""
    if name == SLURM:
        # Without Slurm accounting, submitit warns again and again. Its import sets the level, so it comes first.
        import submitit

        logging.getLogger(submitit.__name__).setLevel(logging.ERROR)
        if "SLURM_JOB_ID" in os.environ:
            # sbatch passes them on: a single job would take its ID from the array that this process's job belongs to.
            for variable in [each for each in os.environ if each.startswith(OF_A_JOB) and each != "SLURM_CONF"]:
                del os.environ[variable]
