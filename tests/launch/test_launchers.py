"""Hydra's launchers for a cluster: their settings, and the error where they cannot be used."""

import os
import sys
import warnings

import pytest
from omegaconf import OmegaConf

from armscan.config.compose import compose
from armscan.errors import InvalidValueError
from armscan.launch.launchers import check_launcher, prepare_launcher
from armscan.utils.log import silence_libraries
from tests.support import FEW_VOLUMES


@pytest.mark.parametrize(
    ("launcher", "package", "command"),
    [
        ("ray", "ray", "pip install 'armscan[ray]'"),
        ("ray", "hydra_plugins.hydra_ray_launcher", "pip install 'armscan[ray]'"),
        ("submitit_slurm", "submitit", "pip install 'armscan[slurm]'"),
    ],
)
def test_launcher_without_its_package_says_what_to_install(monkeypatch, answer, launcher, package, command):
    monkeypatch.setitem(sys.modules, package, None)
    line = f"error: hydra/launcher is {launcher!r}, but {package} is not installed: {command}"
    study = ["-m", "sweep=sac_y", *FEW_VOLUMES]
    for words in (study, ["-m", "seed=0,1"]):
        assert answer(*words, f"hydra/launcher={launcher}") == (2, line)


def test_slurm_is_looked_for_where_the_command_is_typed(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InvalidValueError, match="hydra/launcher is 'submitit_slurm', but this machine has no sbatch"):
        check_launcher("submitit_slurm")


def test_jobs_of_slurm_do_not_inherit_the_job_that_they_are_started_in(monkeypatch):
    for variable in ("SLURM_JOB_ID", "SLURM_ARRAY_TASK_ID", "SUBMITIT_EXECUTOR", "SLURM_CONF", "SBATCH_PARTITION"):
        monkeypatch.setenv(variable, "9")
    prepare_launcher("basic")
    assert os.environ["SLURM_ARRAY_TASK_ID"] == "9"
    prepare_launcher("submitit_slurm")
    left = [each for each in os.environ if each.startswith(("SLURM_", "SUBMITIT_", "SBATCH_"))]
    assert sorted(left) == ["SBATCH_PARTITION", "SLURM_CONF"]


@pytest.mark.parametrize(
    ("launcher", "key", "value"),
    [
        ("submitit_slurm", "max_num_timeout", 1000),
        # One of the launcher's own.
        ("submitit_slurm", "nodes", 1),
        ("ray", "ray.remote.max_retries", -1),
    ],
)
def test_launcher_has_our_values_beside_its_own_and_nobody_is_warned(launcher, key, value):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        silence_libraries()
        config = compose([f"hydra/launcher={launcher}"], return_hydra_config=True)
    assert OmegaConf.select(config.hydra.launcher, key) == value
