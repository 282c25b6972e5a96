"""A folder of volumes with its manifest."""

import pytest

from armscan.errors import InvalidValueError, ManifestError, VolumeError
from armscan.volumes import read_dataset

PLANE = {"rotation": [1.5, -0.5], "translation": [0.0, 7.0]}


def test_read_dataset_reads_the_shared_manifest_as_it_is(dataset):
    assert list(dataset) == [f"0000{number}_labels.nii.gz" for number in (1, 2, 3, 4)]
    first = dataset["00001_labels.nii.gz"]
    assert first.shape == (360, 800, 80)
    assert first.optimal_action.rotation == (-0.9928527805598941, -0.6094905366791772)
    assert first.optimal_action.translation == (0.0, 152.9753754238808)


def test_read_dataset_passes_the_order_of_axes_on(write_labelmap, write_manifest, tiny_volume):
    write_labelmap("a.nii.gz", tiny_volume.labels.transpose(1, 0, 2))
    folder = write_manifest({"a.nii.gz": {**PLANE, "axes": "yxz"}})
    assert read_dataset(folder)["a.nii.gz"].shape == tiny_volume.shape


def test_read_dataset_names_a_missing_folder(tmp_path):
    with pytest.raises(VolumeError, match="nowhere: the folder of volumes does not exist"):
        read_dataset(tmp_path / "nowhere")


def test_read_dataset_refuses_a_file_as_folder(write_labelmap):
    with pytest.raises(VolumeError, match=r"the folder of volumes cannot be read [(]Not a directory"):
        read_dataset(write_labelmap())


@pytest.mark.parametrize("path", [None, 3, b"folder", "a" * 5000])
def test_read_dataset_refuses_what_is_no_path(path):
    with pytest.raises((VolumeError, InvalidValueError), match="folder"):
        read_dataset(path)


def test_read_dataset_refuses_an_empty_folder(tmp_path):
    with pytest.raises(VolumeError, match="holds no volume"):
        read_dataset(tmp_path)


def test_read_dataset_names_a_missing_manifest(write_labelmap, tmp_path):
    write_labelmap("a.nii.gz")
    with pytest.raises(ManifestError, match=r"has no manifest \(manifest\.yaml, .* or optimal_actions\.json\)"):
        read_dataset(tmp_path)


def test_read_dataset_names_an_entry_without_a_file(write_labelmap, write_manifest):
    write_labelmap("a.nii.gz")
    with pytest.raises(ManifestError, match=r"has an entry for b\.nii\.gz, but"):
        read_dataset(write_manifest({"a.nii.gz": PLANE, "b.nii.gz": PLANE}))


def test_read_dataset_names_a_file_without_an_entry(write_labelmap, write_manifest):
    write_labelmap("a.nii.gz")
    write_labelmap("b.nrrd")
    with pytest.raises(ManifestError, match=r"has no entry for b\.nrrd"):
        read_dataset(write_manifest({"a.nii.gz": PLANE}))


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ("{not json", "cannot be read as JSON"),
        ("[]", "is a list, but"),
        ({"a.nii.gz": 3}, r"entry 'a.nii.gz' is 3, but"),
        ({"a.nii.gz": {"rotation": [0, 0]}}, r"entry 'a.nii.gz' has no translation"),
        ({"a.nii.gz": {**PLANE, "rotaton": 1}}, r"entry 'a.nii.gz' has the key 'rotaton'"),
        ({"a.nii.gz": {**PLANE, "rotation": [1]}}, r"entry 'a.nii.gz': rotation is \[1\]"),
        ({"a.nii.gz": {**PLANE, "rotation": "ab"}}, r"entry 'a.nii.gz': rotation is 'ab'"),
        ('{"a.nii.gz": {"rotation": [NaN, 0], "translation": [0, 0]}}', r"entry 'a.nii.gz': rotation is \[nan, 0\]"),
        ({"a.nii.gz": {**PLANE, "rotation": "12"}}, r"entry 'a.nii.gz': rotation is '12'"),
        ({"a.nii.gz": {**PLANE, "rotation": ["1", "2"]}}, r"entry 'a.nii.gz': rotation is \['1', '2'\]"),
        ({"a.nii.gz": {**PLANE, "rotation": [10**400, 0]}}, r"entry 'a.nii.gz': rotation is"),
        ('{"a.nii.gz": {}, "a.nii.gz": {}}', r"the key 'a.nii.gz' appears twice"),
        ("[" * 100_000, "cannot be read as JSON"),
        ({"a.nii.gz": {**PLANE, "axes": 3}}, r"entry 'a.nii.gz': axes is 3"),
    ],
)
def test_read_dataset_says_what_is_wrong_in_the_manifest(write_labelmap, write_manifest, entries, message):
    write_labelmap("a.nii.gz")
    with pytest.raises(ManifestError, match=message):
        read_dataset(write_manifest(entries))
