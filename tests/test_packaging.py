"""The configuration of an installed armscan: wheel, editable install, image."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import armscan
from armscan.config.compose import compose
from armscan.config.trust import TARGETS, offered_classes
from tests.docker.files import instructions
from tests.test_run import SMALL

REPOSITORY = Path(armscan.__file__).parents[1]
BUILT_FROM = ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE", "CHANGELOG.md", "armscan", "conf", "sweeps")
PRIVATE = ("conf/local/services.yaml", "conf/agent/private.yaml", "sweeps/private.yaml", "conf/notes.txt")
# Composes each list of words, and prints where the configuration is.
COMPOSE = """
import json, sys
from armscan.config.compose import compose
from armscan.config.sources import config_folder
for words in json.load(sys.stdin):
    compose(words, return_hydra_config=True)
print(config_folder())
"""


def words_of(path):
    """Return the words that choose a configuration file, given its path in `conf`."""
    group, name = str(path.parent), path.stem
    if group == ".":
        return []
    if group.startswith("study"):
        return ["sweep=sac_y", *([] if name == "base" else [f"{group}={name}"])]
    return [f"{'+' if group == 'cluster' else ''}{group}={name}"]


def configs(checkout):
    """Return the paths of all configuration files of a checkout; its studies are the group `sweep`."""
    groups = {path.relative_to(checkout / "conf") for path in checkout.glob("conf/**/*.yaml")}
    return groups | {Path("sweep", path.name) for path in checkout.glob("sweeps/*.yaml")}


ALL = sorted(configs(REPOSITORY), key=str)


@pytest.mark.parametrize("path", ALL, ids=str)
def test_every_config_and_every_sweep_composes(path, monkeypatch):
    monkeypatch.setenv("ARMSCAN_STORAGE", "postgresql://me@127.0.0.1/studies")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:5000")
    config = compose(words_of(path), return_hydra_config=True)
    if path.parent != Path():
        chosen = config.hydra.runtime.choices
        assert "base" in path.name or chosen[str(path.parent)] == path.stem
    # A stored run of it is built without --trust.
    of_run = {key: value for key, value in config.items() if key not in ("hydra", "study")}
    assert set(TARGETS.findall(OmegaConf.to_yaml(of_run))) <= offered_classes()


def run(*command, cwd, **given):
    # So that the installed package is found, and not the repository.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    words = [str(word) for word in command]
    ended = subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True, check=False, **given)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def build(checkout, target, folder):
    """Build a wheel or a source distribution of a checkout; return the file."""
    run(sys.executable, "-m", "hatchling", "build", "--target", target, "--directory", folder, cwd=checkout)
    (built,) = folder.glob("*.whl" if target == "wheel" else "*.tar.gz")
    return built


def virtual_environment(folder, *installed):
    """Make a virtual environment with these packages and armscan's dependencies alone; return its Python."""
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder.parent)
    (packages,) = folder.glob("lib/python3*/site-packages")
    # In a folder that a .pth file names, other .pth files are not read, such as those of an editable armscan.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    python = folder / "bin" / "python"
    pip = ("-m", "pip", "--quiet", "--disable-pip-version-check", "--python", python, "install")
    run(sys.executable, *pip, "--no-deps", "--no-build-isolation", *installed, cwd=folder)
    return python


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """Return a checkout with private files, which git does not track."""
    folder = tmp_path_factory.mktemp("build") / "checkout"
    folder.mkdir()
    for name in BUILT_FROM:
        source = REPOSITORY / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / name)
    run("git", "init", "--quiet", cwd=folder)
    run("git", "add", "--all", cwd=folder)
    for name in PRIVATE:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("password: secret\n")
    return folder


@pytest.fixture(scope="module")
def wheel(checkout):
    """Return a wheel from the source distribution of the checkout."""
    sdist = build(checkout, "sdist", checkout.parent)
    with tarfile.open(sdist) as archive:
        assert not [name for name in archive.getnames() if "private" in name or "/local/" in name]
        archive.extractall(checkout.parent / "sdist", filter="data")
    (unpacked,) = (checkout.parent / "sdist").iterdir()
    assert configs(unpacked) == configs(REPOSITORY)
    return build(unpacked, "wheel", checkout.parent)


def configs_in(wheel):
    with zipfile.ZipFile(wheel) as contents:
        names = [Path(name) for name in contents.namelist() if name.startswith("armscan/conf/")]
    return {name.relative_to("armscan/conf") for name in names}


def test_wheel_holds_every_config_and_nothing_private(wheel, checkout):
    assert configs_in(wheel) == configs(REPOSITORY)
    direct = build(checkout, "wheel", checkout.parent / "direct")
    assert configs_in(direct) == configs(REPOSITORY)


@pytest.fixture(scope="module")
def python(wheel):
    """Return the Python of an environment in which the wheel is installed."""
    return virtual_environment(wheel.parent / "venv", wheel)


@pytest.mark.slow
def test_wheel_composes_and_plans_in_an_empty_folder(python, tmp_path):
    # What names a cluster needs its services.
    words = json.dumps([words_of(path) for path in ALL if path.parent != Path("cluster")])
    found = Path(run(python, "-c", COMPOSE, cwd=tmp_path, input=words).strip())
    assert found.is_relative_to(python.parents[1])
    assert "agents.SAC" in run(python, "-m", "armscan.run", "--cfg", "job", "agent=sac", cwd=tmp_path)
    armscan_command = python.with_name("armscan")
    assert "study sac_y: what is searched" in run(armscan_command, "run", "-m", "sweep=sac_y", "--plan", cwd=tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.full
@pytest.mark.slow
def test_wheel_trains_a_grid_in_an_empty_folder(python, tmp_path):
    few = [*(word for word in SMALL if not word.startswith("network")), "training.env_steps=200"]
    # One after the other: the second finds what the first has compiled.
    grid = ["-m", "obs=cluster,slice", "agent=sac", "hydra.launcher.n_jobs=1"]
    run(python, "-m", "armscan.run", *grid, *few, cwd=tmp_path)
    assert len(list(tmp_path.glob("multirun/*/*/*/best.pt"))) == 2


@pytest.mark.full
def test_editable_install_reads_the_checkout(checkout, tmp_path):
    python = virtual_environment(tmp_path / "venv", "--editable", checkout)
    assert run(python, "-c", COMPOSE, cwd=tmp_path, input='[["sweep=sac_y"]]').strip() == str(checkout / "conf")
    assert not list((tmp_path / "venv").rglob("armscan/conf"))


@pytest.mark.full
def test_image_is_built_with_every_config(tmp_path):
    stage = instructions()
    stage = stage[: next(i for i, (name, _) in enumerate(stage) if i and name == "FROM")]
    (tmp_path / "build").mkdir()
    wheels = []
    for name, words in stage:
        if name == "COPY":
            *sources, target = words.split()
            for source in sources:
                place = tmp_path / "build" / target / ("" if (REPOSITORY / source).is_dir() else Path(source).name)
                if (REPOSITORY / source).is_dir():
                    shutil.copytree(REPOSITORY / source, place, dirs_exist_ok=True)
                else:
                    place.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy(REPOSITORY / source, place)
        elif "pip install" in words:
            wheels.append(build(tmp_path / "build", "wheel", tmp_path / f"wheel-{len(wheels)}"))
    dependencies, whole = wheels
    assert configs_in(dependencies) == set()
    assert configs_in(whole) == configs(REPOSITORY)
