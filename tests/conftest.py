"""Fixtures shared by many tests: volumes, servers, databases, a browser and the commands."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from armscan.utils.processes import limit_threads
from tests.support.processes import STARTED, end_all, processes_in
from tests.support.requirements import unavailable

# As in a run: the tests use all cores already.
limit_threads()
# A background job of a script ignores SIGINT, and so would all commands that the tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A first compile, or a wait for a busy machine, takes longer than any deadline.
settings.register_profile("armscan", deadline=None)
settings.load_profile("armscan")

DATA = Path(__file__).parent / "data"
# Tests that start servers, clusters or browsers, or compare six real runs, are left to `make test-full`.
FULL_FIXTURES = {"postgres_programs", "artifacts_disk", "cluster", "look", "browser", "runs"}
# Fixtures that take seconds to make, once per module: all tests of a module that use one run on the same worker.
SHARED_FIXTURES = ("runs", "made", "server", "cluster")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        if FULL_FIXTURES.intersection(item.fixturenames):
            item.add_marker(pytest.mark.full)
        for name in SHARED_FIXTURES:
            if name in item.fixturenames:
                item.add_marker(pytest.mark.xdist_group(f"{item.path.stem} {name}"))


@pytest.fixture(scope="session", autouse=True)
def phantom_cache(tmp_path_factory):
    """Keep the tests' phantoms out of the user's cache, for this process and those it starts."""
    folder = tmp_path_factory.mktemp("phantoms")
    os.environ["ARMSCAN_CACHE"] = str(folder)
    return folder


@pytest.fixture(scope="session", autouse=True)
def activated():
    """Put the environment's programs on the path, so that suggested commands begin with their names alone."""
    os.environ["PATH"] = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))


@pytest.fixture(autouse=True)
def no_process_left(request):
    """End what a test that failed has started in its folder."""
    yield
    if (folder := request.node.funcargs.get("tmp_path")) in STARTED:
        end_all(partial(processes_in, folder))


@pytest.fixture(scope="session")
def data_folder():
    """Four full-size labelmaps with their manifest."""
    return DATA / "volumes"


@pytest.fixture(scope="session")
def more_volumes():
    """Return the folder of four further labelmaps, which only slow tests read."""
    return DATA / "more_volumes"


@pytest.fixture(scope="session")
def dataset(data_folder):
    from armscan.volumes import read_dataset

    return read_dataset(data_folder)


@pytest.fixture
def wrists(tmp_path, data_folder):
    """Return a folder of volumes whose manifest splits them."""
    import yaml

    folder = tmp_path / "wrists"
    shutil.copytree(data_folder, folder)
    entries = json.loads((folder / "optimal_actions.json").read_text())
    (folder / "optimal_actions.json").unlink()
    names = list(entries)
    splits = {"train": names[:2], "validation": [names[2]], "test": [names[3]]}
    (folder / "manifest.yaml").write_text(yaml.safe_dump({"volumes": entries, "splits": splits}))
    return folder


@pytest.fixture(scope="session")
def golden():
    """Return the results of an independent implementation for slices of these labelmaps."""
    with np.load(DATA / "golden" / "slices_full.npz") as arrays:
        return dict(arrays)


@pytest.fixture(scope="session")
def phantom():
    from armscan.volumes import load_phantom

    return load_phantom(0)


@pytest.fixture(scope="session")
def tiny_volume():
    """Return a small volume with a block of every landmark, and a different spacing along each axis."""
    return make_tiny_volume()


def make_tiny_volume(name="tiny", optimal_action=None):
    from armscan.volumes import LabelVolume

    labels = np.zeros((30, 20, 12), dtype=np.uint8)
    labels[5:12, 4:15, 2:5] = 1
    labels[14:20, 2:18, 5:8] = 2
    labels[22:26, :, 8:10] = 3
    return LabelVolume(labels, (0.5, 0.7, 0.9), name, optimal_action=optimal_action)


@pytest.fixture
def write_labelmap(tmp_path):
    """Write labels, indexed [x, y, z], as an image file; return its path."""
    import SimpleITK

    def write(name="wrist.nii.gz", labels=None, spacing=(0.3, 0.4, 0.5, 1.0)):
        labels = make_tiny_volume().labels if labels is None else labels
        image = SimpleITK.GetImageFromArray(np.ascontiguousarray(np.transpose(labels)), isVector=False)
        image.SetSpacing(spacing[: image.GetDimension()])
        path = tmp_path / name
        SimpleITK.WriteImage(image, str(path))
        return path

    return write


@pytest.fixture
def write_manifest(tmp_path):
    """Write the manifest beside the labelmaps of `write_labelmap`; return the folder."""

    def write(entries):
        text = entries if isinstance(entries, str) else json.dumps(entries)
        (tmp_path / "optimal_actions.json").write_text(text)
        return tmp_path

    return write


@pytest.fixture
def unseen_windows():
    """Make Matplotlib's windows invisible; close those that are left open."""
    from matplotlib import pyplot

    before = pyplot.get_backend()
    pyplot.switch_backend("module://tests.support.unseen")
    yield
    pyplot.close("all")
    pyplot.switch_backend(before)


@pytest.fixture
def made_read_only():
    """Make a folder read-only for a block, even for root: it is mounted onto itself."""

    @contextlib.contextmanager
    def read_only(folder):
        mounts = (["--bind", str(folder), str(folder)], ["-o", "remount,ro,bind", str(folder)])
        if shutil.which("mount") is None or subprocess.run(["mount", *mounts[0]], check=False).returncode:
            unavailable("a read-only disk cannot be mounted here: it needs root")
        try:
            subprocess.run(["mount", *mounts[1]], check=True)
            yield
        finally:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)

    return read_only


@pytest.fixture
def disk(tmp_path):
    """Yield a disk of 20 MB, which can be filled."""
    from tests.support.disks import small_disk

    with small_disk(tmp_path / "disk", "20m") as disk:
        yield disk


@pytest.fixture(scope="session")
def postgres_programs():
    """Return the folder of PostgreSQL's programs, which tests that start a server of their own need, too."""
    from tests.support.postgres import programs

    if (folder := programs()) is None:
        unavailable("PostgreSQL's initdb and postgres are not installed: apt-get install postgresql")
    return folder


@pytest.fixture(scope="session")
def postgres(postgres_programs):
    """Yield a server for all tests of this process."""
    from tests.support.postgres import postgres_server

    with postgres_server(in_memory=True) as server:
        yield server


@pytest.fixture(scope="session")
def tracking_server(postgres, tmp_path_factory):
    """Yield an MLflow server that keeps its runs in PostgreSQL, for all tests of this process."""
    from tests.support.mlflow_server import mlflow_server

    with mlflow_server(tmp_path_factory.mktemp("mlflow"), postgres.make_database()) as server:
        yield server


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory):
    """Return an empty database with MLflow's tables, which take a second or more to create."""
    from tests.support.stores import store_in

    folder = tmp_path_factory.mktemp("store")
    store_in(folder, "unused")
    return folder / "mlruns.db"


@pytest.fixture
def database(tmp_path, empty_database):
    """Return the address of an empty tracking database in the test's folder, `mlruns.db`."""
    shutil.copy(empty_database, tmp_path)
    return f"sqlite:///{tmp_path}/mlruns.db"


@pytest.fixture
def browser(tmp_path):
    """Yield Chromium with an empty profile."""
    from tests.support.browser import chromium, programs

    if programs() is None:
        unavailable("Chromium or its driver is not installed: apt-get install chromium chromium-driver")
    with chromium(tmp_path / "profile") as started:
        yield started


@pytest.fixture
def armscan(tmp_path, monkeypatch, capsys):
    """Run `armscan` in this process, in an empty folder; return its exit code, standard output and standard error."""
    from armscan.cli.main import main

    def command(*words, cwd=tmp_path):
        monkeypatch.chdir(cwd)
        capsys.readouterr()
        code = main(words)
        printed = capsys.readouterr()
        return code, printed.out, printed.err.strip()

    return command


@pytest.fixture
def evaluate(armscan, database, monkeypatch):
    """Run `armscan evaluate` as `armscan` does, in a folder with an empty tracking database."""
    monkeypatch.setenv("COLUMNS", "200")
    return partial(armscan, "evaluate")


@pytest.fixture
def answer(tmp_path, monkeypatch, capsys):
    """Run `armscan.run` in this process, in an empty folder; return its exit code and standard error."""
    from hydra.core.global_hydra import GlobalHydra

    from armscan import run
    from armscan.launch.multirun import Multirun

    def command(*arguments):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["armscan.run", *arguments])
        monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
        monkeypatch.setattr(Multirun, "folder", None)
        GlobalHydra.instance().clear()
        try:
            code = run.main()
        except SystemExit as leaving:
            code = leaving.code
        return code, capsys.readouterr().err.strip()

    return command
