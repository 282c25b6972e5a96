"""Malicious files: refused at once, in one line, with little memory."""

import gzip
import json
import struct
import time
import tracemalloc
import zlib

import numpy as np
import pytest

from armscan.errors import ArmscanError, ManifestError, VolumeError
from armscan.volumes import LabelVolume, open_dataset, read_volume
from tests.conftest import make_tiny_volume

HUGE, TOO_LARGE = 1000, 1100
# Processor time, set generously: a late refusal takes half a minute or more, or all memory.
MAX_SECONDS, MAX_BYTES = 15.0, 16 << 20
MHA = (
    "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = {compressed}\n"
    "{size}ElementSpacing = 1 1 1\nDimSize = {n} {n} {n}\nElementType = MET_UCHAR\nElementDataFile = {file}\n"
)
NRRD = (
    "NRRD0004\ntype: uchar\ndimension: 3\nspace: left-posterior-superior\nsizes: {n} {n} {n}\n"
    "space directions: (1,0,0) (0,1,0) (0,0,1)\nkinds: domain domain domain\nencoding: {encoding}\n"
    "space origin: (0,0,0)\n{more}\n"
)


def nifti(n, begin=352.0, magic=b"n+1\0", place=1.0, qform=None, scaling=(0.0, 0.0)):
    """Return the header of a NIfTI file of n x n x n bytes."""
    header = bytearray(352)
    struct.pack_into("<i", header, 0, 348)
    struct.pack_into("<8h", header, 40, 3, n, n, n, 1, 1, 1, 1)
    struct.pack_into("<2h", header, 70, 2, 8)
    struct.pack_into("<8f", header, 76, *[1.0] * 8)
    struct.pack_into("<3f", header, 108, begin, *scaling)
    struct.pack_into("<12f", header, 280, *[place, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0])
    struct.pack_into("<6f", header, 256, *qform or [0.0] * 6)
    struct.pack_into("<2h", header, 252, qform is not None, 1)
    header[344:348] = magic
    return bytes(header)


def mha(n, voxels, *, compressed=False, file="LOCAL"):
    size = f"CompressedDataSize = {len(voxels)}\n" if compressed else ""
    return MHA.format(n=n, compressed=compressed, size=size, file=file).encode() + voxels


def nrrd(n, voxels=b"", *, encoding="raw", more=""):
    return NRRD.format(n=n, encoding=encoding, more=more).encode() + voxels


@pytest.fixture
def refusal(tmp_path, capfd):
    """Return a function that reads a file and returns the line that refuses it, quickly and with little memory."""

    def refused(name, contents, beside=()):
        for other, others in {**dict(beside), name: contents}.items():
            (tmp_path / other).write_bytes(others)
        # Imported before the clock starts.
        import SimpleITK  # noqa: F401

        tracemalloc.start()
        began = time.process_time()
        with pytest.raises(VolumeError) as caught:
            read_volume(tmp_path / name)
        took, (_, most) = time.process_time() - began, tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert took < MAX_SECONDS
        assert most < MAX_BYTES
        assert capfd.readouterr() == ("", "")
        assert len(str(caught.value).splitlines()) == 1
        return str(caught.value)

    return refused


SMALL = bytes(500)
DECLARED = {
    "a.nii": nifti(HUGE) + SMALL,
    "a.nii.gz": gzip.compress(nifti(HUGE) + SMALL),
    "a.mha": mha(HUGE, SMALL),
    "z.mha": mha(HUGE, zlib.compress(SMALL), compressed=True),
    "a.nrrd": nrrd(HUGE, SMALL),
    "z.nrrd": nrrd(HUGE, gzip.compress(SMALL), encoding="gzip"),
    "a.mhd": mha(HUGE, b"", file="a.raw"),
    "d.nrrd": nrrd(HUGE, more="data file: a.raw\n"),
}


@pytest.mark.parametrize("name", DECLARED)
def test_a_small_file_that_declares_a_large_image_is_refused_at_once(refusal, name):
    # For NIfTI including the header.
    assert str(HUGE**3 + 352 * (".nii" in name)) in refusal(name, DECLARED[name], {"a.raw": SMALL})


@pytest.mark.parametrize("name", ["a.nii", "a.mha", "a.nrrd"])
def test_an_image_of_more_voxels_than_any_scanner_produces_is_refused(refusal, name):
    # Its compressed voxels may be few bytes, and true.
    contents = {"a.nii": nifti(TOO_LARGE), "a.mha": mha(TOO_LARGE, b""), "a.nrrd": nrrd(TOO_LARGE)}
    assert f"the image has {TOO_LARGE**3} voxels, but a labelmap has at most {2**30}" in refusal(name, contents[name])


def test_metaimage_may_have_the_fields_that_itk_writes_of_other_formats(tmp_path):
    fields = b"dim[0] = 3\npixdim[1] = 0.27\n0008|0060 = MR\nDimSize"
    voxels = np.arange(1000, dtype=np.uint8) % 4
    (tmp_path / "a.mha").write_bytes(mha(10, voxels.tobytes()).replace(b"DimSize", fields))
    np.testing.assert_array_equal(read_volume(tmp_path / "a.mha").labels.transpose(2, 1, 0).ravel(), voxels)


def test_an_image_of_several_values_in_a_voxel_is_refused(refusal):
    several = mha(10, bytes(3000)).replace(b"DimSize", b"ElementNumberOfChannels = 3\nDimSize")
    assert "ElementNumberOfChannels is 3, but a labelmap has one value per voxel" in refusal("a.mha", several)


@pytest.mark.parametrize("name", ["a.mha", "a.nrrd"])
def test_a_header_of_blanks_is_refused_at_once(refusal, name):
    assert refusal(name, nrrd(2, more=f"a{' ' * 500_000}b") if name == "a.nrrd" else b"a" + b" " * 500_000 + b"b\n")


BOMB = bytes(64 << 20)
BOMBS = {
    "a.nii.gz": gzip.compress(nifti(10) + BOMB),
    "a.mha": mha(10, zlib.compress(BOMB), compressed=True),
    "a.nrrd": nrrd(10, gzip.compress(BOMB), encoding="gzip"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_stream_is_inflated_no_further_than_declared(refusal, name):
    assert "the file is damaged: it holds more than" in refusal(name, BOMBS[name])


VOXELS = np.ascontiguousarray(make_tiny_volume().labels[:10, :10, :10].T).tobytes()


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (nifti(10, begin=0.0), "the header ends at byte 352, but its voxels begin at byte 0"),
        (nifti(10, begin=348.0), "the header ends at byte 352, but its voxels begin at byte 348"),
        (nifti(10, begin=352.5), "the header ends at byte 352, but its voxels begin at byte 352.5"),
        (nifti(10, begin=float("nan")), "its voxels begin at byte nan"),
        (nifti(10, magic=b"ni1\0"), "of a pair of files (.hdr and .img), which cannot be read"),
        (nifti(10, magic=bytes(4)), "of a pair of files (.hdr and .img), which cannot be read"),
        (nifti(10, place=float("nan")), "its qform or sform holds a NaN"),
        (nifti(10, place=float("inf")), "its qform or sform holds a NaN"),
        (nifti(10, qform=(0, 0, 0.1, 0, 0, 0)), "qform and sform state directions that differ by up to 11.5°"),
        (nifti(10, qform=(0, 0, 1, 0, 0, 0)), "qform and sform state directions that differ by up to 180°"),
        (nifti(10, qform=(0, 0, 0, 0.2, 0, 0)), "state the origins (0.2, 0, 0) and (0, 0, 0), which may differ by 0.1"),
        (nifti(10, scaling=(2.0, 0.0)), "its voxels are scaled: scl_slope is 2"),
        (
            nifti(10, scaling=(0.0, 1.0)),
            "its voxels are scaled: scl_slope is 0, but must be 0 or 1, and scl_inter is 1",
        ),
        (nifti(10, scaling=(-1.0, 3.0)), "its voxels are scaled: scl_slope is -1"),
        (nifti(10, scaling=(float("nan"), 1.0)), "its voxels are scaled: scl_slope is nan"),
        (nifti(10, scaling=(1.0, float("inf"))), "its voxels are scaled: scl_slope is 1"),
        (struct.pack("<i", 540) + nifti(10)[4:], "the file is NIfTI-2, but NIfTI-1 is read"),
        (nifti(10, place=1.01), "the spacing is (1, 1, 1) by pixdim, but (1.01, 1, 1) by the sform"),
        (nifti(10, place=-0.99), "the spacing is (1, 1, 1) by pixdim, but (0.99, 1, 1) by the sform"),
    ],
)
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_nifti_headers_that_would_be_mended_or_printed_about_are_refused(refusal, name, header, message):
    contents = header + VOXELS
    assert message in refusal(name, gzip.compress(contents) if name.endswith("gz") else contents)


@pytest.mark.parametrize("scaling", [(0.0, 0.0), (1.0, 0.0), (float("nan"), float("nan")), (0.0, float("nan"))])
def test_nifti_without_scaling_is_read_however_it_says_so(tmp_path, scaling):
    voxels = np.arange(1000, dtype=np.uint8) % 4
    voxels[0] = 3
    (tmp_path / "a.nii").write_bytes(nifti(10, scaling=scaling) + voxels.tobytes())
    np.testing.assert_array_equal(np.bincount(read_volume(tmp_path / "a.nii").labels.ravel()), np.bincount(voxels))


@pytest.mark.parametrize(
    "line",
    [
        b"Offset = 5",
        b"Offset = 0 000",
        b"CenterOfRotation = 0 000",
        b"TransformMatrix = 1 0 0 0 1 0 0 0",
        b"Color = 1 0 0",
        b"ElementMin =",
        b"ElementToIntensityFunctionSlope =",
    ],
)
def test_metaimage_field_that_would_swallow_the_spacing_is_refused(refusal, line):
    contents = mha(10, VOXELS).replace(b"ElementSpacing", line + b"\nElementSpacing")
    name, _, value = line.decode().partition(" =")
    assert f"a.mha: {name} is {value.strip()!r}, but it must be " in refusal("a.mha", contents)


@pytest.mark.parametrize(
    "lines",
    [
        b"Offset = 0 0 0\nPosition = 0 0 5",
        b"TransformMatrix = 1 0 0 0 1 0 0 0 1\nOrientation = 0 1 0 1 0 0 0 0 1",
    ],
)
def test_metaimage_that_contradicts_itself_is_refused(refusal, lines):
    contents = mha(10, VOXELS).replace(b"ElementSpacing", lines + b"\nElementSpacing")
    assert "differ, but only one of them is used: remove the wrong one" in refusal("a.mha", contents)


def test_nrrd_of_open_brackets_is_refused_at_once(refusal):
    contents = nrrd(10, VOXELS).replace(b"(1,0,0) (0,1,0) (0,0,1)", b"(" * 500_000)
    assert "space directions is '((((" in refusal("a.nrrd", contents)


@pytest.mark.parametrize(
    ("name", "contents", "message"),
    [
        ("a.nrrd", nrrd(10, VOXELS, encoding="ascii"), "the encoding is 'ascii'"),
        ("a.nrrd", nrrd(10, VOXELS, encoding="hex"), "the encoding is 'hex'"),
        ("a.nrrd", nrrd(10, VOXELS, encoding="bzip2"), "the encoding is 'bzip2'"),
        ("a.nrrd", nrrd(10, VOXELS, more="byte skip: -1\n"), "with skips of -1 or 0"),
        ("a.nrrd", nrrd(10, more="data file: LIST\n"), "there is no such file"),
        ("a.mha", mha(10, VOXELS).replace(b"BinaryData = True", b"BinaryData = False"), "BinaryData is False"),
        ("a.mhd", mha(10, b"", file="a.%03d 1 10 1"), "there is no such file"),
        ("a.mha", mha(10, VOXELS).replace(b"NDims", b"HeaderSize = 5\nNDims"), "HeaderSize is 5"),
        ("a.mha", mha(10, VOXELS + b"1"), "the file is damaged: it holds more than 1000 bytes"),
        (
            "a.nrrd",
            nrrd(10, VOXELS, more='space units: "um" "um" "um"\n'),
            "space units is 'um', but only volumes in mm",
        ),
        ("a.nrrd", nrrd(10, VOXELS).replace(b"(0,0,0)", b"(0,nan,0)"), "space origin is '(0,nan,0)', but it must be"),
        (
            "a.nrrd",
            nrrd(10, VOXELS).replace(b"left-posterior-superior", b"3D-left-handed"),
            "space is 3d-left-handed, which does not say where left, posterior and superior are",
        ),
        ("a.mha", mha(10, VOXELS).replace(b"NDims", b"DistanceUnits = um\nNDims"), "DistanceUnits is 'um', but only"),
        ("a.mha", mha(10, VOXELS).replace(b"NDims", b"Offset = nan 2 3\nNDims"), "Offset is 'nan 2 3', but it must be"),
        ("a.nrrd", nrrd(10, VOXELS + b"1"), "the file is damaged: it holds more than 1000 bytes"),
    ],
)
def test_voxels_that_cannot_be_checked_are_refused(refusal, name, contents, message):
    assert message in refusal(name, contents)


def damaged_manifest(folder, name, text):
    """Return the line in which a manifest is refused, and how long that takes."""
    (folder / name).write_text(text)
    began = time.process_time()
    with pytest.raises(ManifestError) as caught:
        open_dataset(folder)
    assert len(str(caught.value).splitlines()) == 1
    return str(caught.value), time.process_time() - began


@pytest.mark.parametrize("name", ["manifest.yaml", "manifest.json"])
def test_a_manifest_of_many_missing_files_names_four_of_them(write_labelmap, tmp_path, name):
    write_labelmap("a.nii.gz")
    entries = {
        f"missing_{number:05d}.nii.gz": {"subject": f"S{number}", "rotation": [0, 0]} for number in range(10_000)
    }
    for entry in entries.values():
        entry["translation"] = [0, 1]
    message, took = damaged_manifest(tmp_path, name, json.dumps({"volumes": entries}, indent=1))
    assert "missing_00003.nii.gz and 9996 more" in message
    assert took < MAX_SECONDS


@pytest.mark.parametrize("depth", [900, 3000, 100_000])
@pytest.mark.parametrize(
    ("name", "opens", "closes"),
    [
        ("manifest.yaml", "[", "]"),
        ("manifest.yaml", "{a: ", "}"),
        ("manifest.yaml", "- ", ""),
        ("manifest.json", "[", "]"),
        ("manifest.json", '{"volumes": ', "}"),
    ],
)
def test_a_manifest_that_is_nested_deeply_is_refused_at_once(write_labelmap, tmp_path, name, opens, closes, depth):
    write_labelmap("a.nii.gz")
    _, took = damaged_manifest(tmp_path, name, opens * depth + "1" + closes * depth)
    assert took < MAX_SECONDS


def test_a_manifest_that_repeats_itself_without_end_is_refused_at_once(write_labelmap, tmp_path):
    write_labelmap("a.nii.gz")
    laughs = "\n".join(f"  l{n}: &l{n} [{', '.join([f'*l{n - 1}'] * 10)}]" for n in range(1, 12))
    text = f"labels:\n  l0: &l0 [1]\n{laughs}\n"
    assert damaged_manifest(tmp_path, "manifest.yaml", text)[1] < MAX_SECONDS
    text = f"volumes:\n  l0: &l0 [1]\n{laughs}\n  a.nii.gz: {{labels: {{bones: *l11, tendons: [1], artery: [2]}}}}"
    assert damaged_manifest(tmp_path, "manifest.yaml", text)[1] < MAX_SECONDS


@pytest.mark.parametrize(
    "name", ["\x1b[31mred\x1b[0m", "bell\a", "over\rwritten", "two\nlines", "\u202eback", "\x9b1m"]
)
def test_control_characters_of_names_are_spelled_out(write_labelmap, tmp_path, name):
    with pytest.raises(VolumeError, match="must be a string without control characters") as caught:
        LabelVolume(make_tiny_volume().labels, (1.0, 1.0, 1.0), name)
    messages = [str(caught.value), str(ArmscanError(f"{name} is wrong"))]
    with pytest.raises(VolumeError) as caught:
        read_volume(tmp_path / f"{name}.nii")
    messages.append(str(caught.value))
    write_labelmap(f"{name}.nrrd")
    for entries in ({}, {f"{name}.nrrd": {}}, {"a.nrrd": {"subject": name}}, {"a.nrrd": {"exclude": name}}):
        write_labelmap("a.nrrd")
        messages.append(damaged_manifest(tmp_path, "manifest.json", json.dumps({"volumes": entries}))[0])
    assert all(message.isprintable() for message in messages)
