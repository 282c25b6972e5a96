"""Reading image files, whole ones and damaged ones."""

import struct

import numpy as np
import pytest

from armscan.errors import InvalidValueError, VolumeError
from armscan.volumes import read_volume

FORMATS = ["wrist.nii", "wrist.nii.gz", "wrist.nrrd", "wrist.mha", "wrist.mhd"]


@pytest.mark.parametrize("name", FORMATS)
def test_read_volume_gives_what_was_written(write_labelmap, tiny_volume, name):
    volume = read_volume(write_labelmap(name))
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels)
    assert volume.spacing == pytest.approx((0.3, 0.4, 0.5))
    assert volume.name == name


def test_read_volume_gives_the_file_that_was_named_not_its_twin_beside_it(write_labelmap, tiny_volume):
    twin = write_labelmap("wrist.nii", labels=tiny_volume.labels[::-1])
    volume = read_volume(write_labelmap("wrist.nii.gz"))
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels)
    np.testing.assert_array_equal(read_volume(twin).labels, tiny_volume.labels[::-1])


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.uint16, np.float32, np.float64])
def test_read_volume_accepts_any_type_of_whole_numbers(write_labelmap, tiny_volume, dtype):
    volume = read_volume(write_labelmap(labels=tiny_volume.labels.astype(dtype)))
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels)


def test_read_volume_brings_stored_axes_into_order(write_labelmap, tiny_volume):
    stored = tiny_volume.labels.transpose(2, 0, 1)
    volume = read_volume(write_labelmap(labels=stored, spacing=(0.9, 0.5, 0.7, 1.0)), axes="zxy")
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels)
    assert volume.spacing == pytest.approx((0.5, 0.7, 0.9))


@pytest.mark.parametrize("axes", ["xy", "xxz", "abc", "xyzz", None, 3])
def test_read_volume_refuses_axes_that_are_no_order(write_labelmap, axes):
    with pytest.raises(VolumeError, match=f"axes is {axes!r}"):
        read_volume(write_labelmap(), axes=axes)


def test_read_volume_names_a_missing_file(tmp_path):
    with pytest.raises(VolumeError, match=r"nowhere\.nii: there is no such file"):
        read_volume(tmp_path / "nowhere.nii")


@pytest.mark.parametrize("path", [None, 3, b"wrist.nii", "a" * 5000 + ".nii"])
def test_read_volume_refuses_what_is_no_path(path):
    with pytest.raises((VolumeError, InvalidValueError), match="file"):
        read_volume(path)


def test_read_volume_refuses_more_voxels_than_the_file_holds(write_labelmap):
    """Even where the header understates the size of a voxel, so that its own sum comes out right."""
    path = write_labelmap("wrist.nii")
    damaged = bytearray(path.read_bytes())
    struct.pack_into("<h", damaged, 46, 60)
    struct.pack_into("<h", damaged, 72, 1)
    path.write_bytes(damaged)
    with pytest.raises(VolumeError, match=r"wrist\.nii: the file is truncated"):
        read_volume(path)


def test_read_volume_names_the_endings_it_reads(tmp_path):
    with pytest.raises(VolumeError, match=r"wrist\.png: a volume is read from .*\.nii\.gz"):
        read_volume(tmp_path / "wrist.png")


@pytest.mark.parametrize("name", FORMATS[:4])
@pytest.mark.parametrize("kept", [0.0, 0.05, 0.5, 0.9])
def test_read_volume_refuses_a_truncated_file(write_labelmap, name, kept):
    path = write_labelmap(name)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(VolumeError, match=name):
        read_volume(path)


def test_read_volume_refuses_a_compressed_file_without_its_last_bytes(write_labelmap):
    path = write_labelmap("wrist.nii.gz")
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(VolumeError, match=r"wrist\.nii\.gz: .*truncated"):
        read_volume(path)


@pytest.mark.parametrize("name", FORMATS[:4])
def test_read_volume_refuses_what_is_no_image(tmp_path, name):
    (tmp_path / name).write_bytes(np.random.default_rng(0).bytes(5000))
    with pytest.raises(VolumeError, match=name):
        read_volume(tmp_path / name)


@pytest.mark.parametrize(("shape", "dimension"), [((30, 20), 2), ((30, 20, 6, 2), 4)])
def test_read_volume_refuses_an_image_that_is_not_3d(write_labelmap, shape, dimension):
    with pytest.raises(VolumeError, match=f"{dimension}-D.*3-D"):
        read_volume(write_labelmap(labels=np.ones(shape, np.uint8)))


@pytest.mark.parametrize("name", ["wrist.nii.gz", "wrist.mha"])
def test_read_volume_takes_a_single_point_in_time(write_labelmap, tiny_volume, name):
    volume = read_volume(write_labelmap(name, labels=tiny_volume.labels[..., np.newaxis]))
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels)
    assert volume.spacing == pytest.approx((0.3, 0.4, 0.5))


def test_read_volume_refuses_an_image_of_no_voxels(write_labelmap):
    path = write_labelmap("wrist.mha")
    path.write_bytes(path.read_bytes().replace(b"DimSize = 30 20 12", b"DimSize = 30 20 00"))
    with pytest.raises(VolumeError, match=r"wrist\.mha: the image has the size \(30, 20, 0\), but"):
        read_volume(path)


def test_read_volume_refuses_a_header_without_its_data(write_labelmap):
    path = write_labelmap("wrist.mhd")
    path.with_suffix(".raw").unlink()
    with pytest.raises(VolumeError, match=r"wrist\.mhd: "):
        read_volume(path)


def test_read_volume_refuses_a_file_that_gives_no_spacing(write_labelmap):
    for name, key in (("wrist.mha", b"ElementSpacing"), ("wrist.nrrd", b"space directions")):
        path = write_labelmap(name)
        path.write_bytes(path.read_bytes().replace(key, b"No" + key))
        with pytest.raises(VolumeError, match=f"{name}: the file gives no spacing"):
            read_volume(path)


def test_read_volume_refuses_a_name_that_is_no_text(write_labelmap):
    path = write_labelmap("wrist.nrrd")
    renamed = path.rename(path.with_name("wrist\udcff.nrrd"))
    with pytest.raises(VolumeError, match=r"wrist\\udcff\.nrrd': the file's name must be valid UTF-8"):
        read_volume(renamed)


def test_read_volume_refuses_grey_values(write_labelmap):
    grey = np.random.default_rng(0).normal(100, 30, (10, 10, 10)).astype(np.float32)
    with pytest.raises(VolumeError, match=r"wrist\.nii\.gz: .*grey values"):
        read_volume(write_labelmap(labels=grey))


def test_read_volume_refuses_a_missing_landmark(write_labelmap, tiny_volume):
    with pytest.raises(VolumeError, match=r"wrist\.nii\.gz: no voxel is labelled 3"):
        read_volume(write_labelmap(labels=np.where(tiny_volume.labels == 3, 0, tiny_volume.labels)))


@pytest.mark.parametrize("axis", [1, 2, 3])
@pytest.mark.parametrize("spacing", [float("nan"), -0.3, 0.0, float("inf")])
def test_read_volume_refuses_impossible_spacing_in_nifti(write_labelmap, spacing, axis):
    path = write_labelmap("wrist.nii")
    damaged = bytearray(path.read_bytes())
    struct.pack_into("<f", damaged, 76 + 4 * axis, spacing)
    path.write_bytes(damaged)
    with pytest.raises(VolumeError, match=r"wrist\.nii: the spacing in the file is"):
        read_volume(path)


@pytest.mark.parametrize("spacing", [b"nan", b"-0.3", b"0"])
@pytest.mark.parametrize(
    ("name", "before"), [("wrist.mha", b"ElementSpacing = "), ("wrist.nrrd", b"space directions: (")]
)
def test_read_volume_refuses_impossible_spacing_in_text_headers(write_labelmap, name, before, spacing):
    path = write_labelmap(name, spacing=(0.25, 0.4, 0.5, 1.0))
    whole = path.read_bytes()
    assert before + b"0.25" in whole
    path.write_bytes(whole.replace(before + b"0.25", before + spacing))
    if name.endswith("nrrd") and spacing == b"-0.3":
        # A negative space direction is an orientation, not a spacing.
        assert read_volume(path).spacing == pytest.approx((0.3, 0.4, 0.5))
    else:
        with pytest.raises(VolumeError, match=f"{name}: the spacing in the file is"):
            read_volume(path)


def test_read_volume_keeps_the_way_back_to_world_coordinates(tmp_path, tiny_volume):
    import SimpleITK

    image = SimpleITK.GetImageFromArray(np.ascontiguousarray(tiny_volume.labels.transpose(2, 1, 0)))
    image.SetOrigin((10.0, -20.0, 30.0))
    image.SetDirection((0, -1, 0, 1, 0, 0, 0, 0, 1))
    SimpleITK.WriteImage(image, str(tmp_path / "turned.nii.gz"))
    volume = read_volume(tmp_path / "turned.nii.gz")
    assert volume.origin == pytest.approx((10.0, -20.0, 30.0))
    np.testing.assert_allclose(volume.direction, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels)
