"""One changed byte anywhere in any file: refused in one line, or the same voxels.

Two kinds of bytes have no checksum, so a change to them cannot be detected:

- A voxel that is not compressed: only this voxel may change.
- A header that is not compressed: where the image lies in the world, and its spacing, are what the changed header says.

Everything else, a compressed file or stream, is refused, or gives the same voxels at the same place.
"""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from armscan.volumes import read_volume
from tests.conftest import make_tiny_volume
from tests.volumes.test_damaged import result_of, write_whole

SETTINGS = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
# By key, each with a folder of its own: the file to read, and in DAMAGED the file to damage if it is another one.
PLAIN = {"nii": "wrist.nii", "nrrd": "wrist.nrrd", "mha": "wrist.mha", "mhd": "wrist.mhd", "raw": "wrist.mhd"}
COMPRESSED = {"nii.gz": "wrist.nii.gz", "nrrd.gz": "wrist.nrrd", "mha.z": "wrist.mha", "zraw": "wrist.mhd"}
SEGMENTATIONS = {"seg": "wrist.seg.nrrd", "layers": "layers.seg.nrrd"}
FILES = PLAIN | COMPRESSED | SEGMENTATIONS
DAMAGED = {"raw": "wrist.raw", "zraw": "wrist.zraw"}
N_VOXEL_BYTES = make_tiny_volume().labels.size * 2


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Return a folder with one whole file for each key of `FILES`."""
    folders = {key: tmp_path_factory.mktemp("stored") for key in FILES}
    for key, folder in folders.items():
        write_whole(folder / FILES[key], is_compressed=key in COMPRESSED)
    return folders


def read_with(folder, name, damaged_name, damaged):
    """Read a file of a folder while one of its files is damaged; return None if it is refused, in one line."""
    whole = (folder / damaged_name).read_bytes()
    (folder / damaged_name).write_bytes(damaged)
    try:
        return result_of(lambda: read_volume(folder / name))
    finally:
        (folder / damaged_name).write_bytes(whole)


def check_byte(folder, key, position, value):
    name, damaged_name = FILES[key], DAMAGED.get(key, FILES[key])
    whole = (folder / damaged_name).read_bytes()
    damaged = bytearray(whole)
    damaged[position] = value
    expected, volume = read_volume(folder / name), read_with(folder, name, damaged_name, bytes(damaged))
    if volume is None:
        return
    in_plain_voxels = key in PLAIN and key != "mhd" and position >= len(whole) - N_VOXEL_BYTES
    assert volume.shape == expected.shape
    assert (volume.labels != expected.labels).sum() <= in_plain_voxels
    is_header = key not in ("nii.gz", "zraw", "raw") and not in_plain_voxels
    if not is_header:
        assert (volume.spacing, volume.origin) == (expected.spacing, expected.origin)
        np.testing.assert_array_equal(volume.direction, expected.direction)


@pytest.mark.parametrize("key", FILES)
@SETTINGS
@given(data=st.data(), value=st.integers(0, 255))
def test_one_changed_byte_is_refused_or_changes_no_other_voxel(stored, capfd, key, data, value):
    n_bytes = (stored[key] / DAMAGED.get(key, FILES[key])).stat().st_size
    # Mostly in the header, where a change matters most.
    position = data.draw(st.integers(0, min(n_bytes, 700) - 1) | st.integers(0, n_bytes - 1))
    check_byte(stored[key], key, position, value)
    assert capfd.readouterr() == ("", "")
