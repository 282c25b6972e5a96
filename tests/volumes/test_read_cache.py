"""Labelmaps are read once, and again whenever anything that they depend on has changed."""

import gzip
import json
from importlib.metadata import version

import pytest

from armscan.errors import VolumeError
from armscan.volumes import open_dataset, read_cache, reading
from tests.volumes.test_dataset import PLANE
from tests.volumes.test_mapped import assert_same_volume


@pytest.fixture
def n_read(monkeypatch, tmp_path):
    """Give the test a cache of its own; return a function that counts the files read so far."""
    read, counted = reading.read_stored, []
    monkeypatch.setenv("ARMSCAN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(reading, "read_stored", lambda *a, **k: counted.append(a) or read(*a, **k))
    return lambda: len(counted)


def assert_same(one, other):
    assert one.reports.keys() == other.reports.keys()
    for name, volume in one.volumes.items():
        assert_same_volume(volume, other.volumes[name])
        assert one.reports[name].stored == other.reports[name].stored


@pytest.mark.parametrize("name", ["a.nii.gz", "a.nii", "a.nrrd", "a.mha"])
def test_file_is_read_once(name, write_labelmap, write_manifest, n_read):
    write_labelmap(name)
    folder = write_manifest({name: {**PLANE, "orientation": "RAS", "crop_mm": {"y": [0.0, 6.0]}}})
    read = open_dataset(folder)
    assert n_read() == 1
    assert_same(open_dataset(folder), read)
    assert n_read() == 1


def test_segments_and_values_that_were_found_are_kept(write_labelmap, write_manifest, n_read):
    write_labelmap("a.nii.gz")
    labels = {"bones": [1], "tendons": [2], "artery": [3, 9], "others": "background"}
    folder = write_manifest({"a.nii.gz": {**PLANE, "labels": labels}})
    read, again = open_dataset(folder), open_dataset(folder)
    assert n_read() == 1
    assert_same(read, again)
    assert again.reports["a.nii.gz"].stored.missing == (9,)


@pytest.mark.parametrize(
    "change", [{"translation": [0.0, 7.5]}, {"crop_mm": {"x": [0.0, 8.0]}}, {"orientation": "LPS"}]
)
def test_file_is_read_anew_where_it_is_read_otherwise(change, write_labelmap, write_manifest, n_read):
    write_labelmap("a.nii.gz")
    for plane in (PLANE, {**PLANE, **change}, PLANE):
        read = open_dataset(write_manifest({"a.nii.gz": plane}))
    assert n_read() == 2
    assert read.volumes["a.nii.gz"].optimal_action.translation == (0.0, 7.0)


def test_file_is_read_anew_where_it_has_changed(write_labelmap, write_manifest, n_read, tiny_volume):
    path = write_labelmap("a.nii.gz")
    folder = write_manifest({"a.nii.gz": PLANE})
    open_dataset(folder)
    labels = tiny_volume.labels.copy()
    labels[0, 0, 0] = 4
    write_labelmap("a.nii.gz", labels)
    assert open_dataset(folder).volumes["a.nii.gz"].labels[0, 0, 0] == 4
    assert n_read() == 2
    # The same voxels, compressed differently.
    path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes()), 1))
    open_dataset(folder)
    assert n_read() == 3


@pytest.mark.parametrize("package", ["SimpleITK", "slicerio", "pynrrd"])
def test_file_is_read_anew_by_another_version_of_its_readers(
    package, write_labelmap, write_manifest, n_read, monkeypatch
):
    write_labelmap("a.nii.gz")
    folder = write_manifest({"a.nii.gz": PLANE})
    open_dataset(folder)
    read_cache._code_version.cache_clear()
    monkeypatch.setattr(read_cache, "version", lambda name: "99" if name == package else version(name))
    open_dataset(folder)
    read_cache._code_version.cache_clear()
    assert n_read() == 2


def test_damaged_cache_is_not_believed(write_labelmap, write_manifest, n_read, tmp_path):
    write_labelmap("a.nii.gz")
    folder = write_manifest({"a.nii.gz": PLANE})
    read = open_dataset(folder)
    (kept,) = (tmp_path / "cache").glob("*.volume")
    damaged = bytearray(kept.read_bytes())
    damaged[-9] ^= 1
    kept.unlink()
    kept.write_bytes(damaged)
    assert_same(open_dataset(folder), read)
    assert n_read() == 2


def test_voxels_in_another_file_are_read_each_time(write_labelmap, write_manifest, n_read, tiny_volume, tmp_path):
    write_labelmap("a.mhd")
    folder = write_manifest({"a.mhd": PLANE})
    open_dataset(folder)
    labels = tiny_volume.labels.copy()
    labels[0, 0, 0] = 4
    write_labelmap("a.mhd", labels)
    assert open_dataset(folder).volumes["a.mhd"].labels[0, 0, 0] == 4
    assert n_read() == 2
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("header", ["data file: voxels.raw", "DataFile: voxels.raw"])
def test_nrrd_with_voxels_in_another_file_is_read_each_time(header, write_manifest, n_read, tiny_volume, tmp_path):
    fields = ["NRRD0004", "type: uint8", "dimension: 3", "sizes: 30 20 12", "spacings: 0.5 0.7 0.9", "encoding: raw"]
    (tmp_path / "a.nrrd").write_text("\n".join([*fields, header, "\n"]))
    folder = write_manifest({"a.nrrd": PLANE})
    labels = tiny_volume.labels.copy()
    for first in (0, 4):
        labels[0, 0, 0] = first
        (tmp_path / "voxels.raw").write_bytes(labels.tobytes(order="F"))
        assert open_dataset(folder).volumes["a.nrrd"].labels[0, 0, 0] == first
    assert n_read() == 2


def test_resampled_volumes_are_kept(write_labelmap, n_read, monkeypatch, tmp_path):
    write_labelmap("a.nii.gz")
    write_labelmap("b.nii.gz", spacing=(0.3, 0.4, 0.25))
    manifest = {"spacing": "finest", "volumes": {"a.nii.gz": PLANE, "b.nii.gz": PLANE}}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    read = open_dataset(tmp_path)
    assert read.volumes["a.nii.gz"].shape == (30, 20, 23)
    monkeypatch.setattr(read_cache, "resample", None)
    assert_same(open_dataset(tmp_path), read)


def test_file_that_changes_while_it_is_read_is_refused_and_not_kept(
    write_labelmap, write_manifest, n_read, monkeypatch
):
    path, read = write_labelmap("a.nii"), reading.read_stored
    folder, before = write_manifest({"a.nii": PLANE}), path.read_bytes()

    def changed(file, *arguments, **options):
        made = read(file, *arguments, **options)
        file.write_bytes(before + b"\0")
        return made

    with monkeypatch.context() as patched:
        patched.setattr(reading, "read_stored", changed)
        with pytest.raises(VolumeError, match=r"a.nii: has changed while it was read"):
            open_dataset(folder)
    path.write_bytes(before)
    open_dataset(folder)
    assert n_read() == 2
