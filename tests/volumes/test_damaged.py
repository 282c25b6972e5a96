"""Damaged files and odd arguments are read as a volume, or refused with one of the project's own exceptions."""

import json

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from armscan.errors import ArmscanError
from armscan.volumes import LabelMap, LabelVolume, ManipulatorAction, open_dataset, read_volume, record_planes
from tests.conftest import make_tiny_volume
from tests.volumes.test_reading import FORMATS
from tests.volumes.test_segmentation import NAMES, write_segmentation

FILES = [*FORMATS, "wrist.seg.nrrd", "layers.seg.nrrd"]
SETTINGS = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

# Anything that somebody might pass.
numbers = st.integers(-5, 5) | st.floats() | st.booleans() | st.integers()
anything = st.recursive(
    st.none() | numbers | st.text(max_size=5) | st.binary(max_size=3) | st.just(np.zeros((2, 2, 2))),
    lambda inner: (
        st.lists(inner, max_size=4) | st.tuples(inner, inner) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
    ),
    max_leaves=6,
)
# What JSON and YAML can hold.
values = st.recursive(
    st.none() | numbers | st.text(max_size=5) | st.sampled_from(["xyz", "LPS", "a.nii.gz", "S1"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


def outcome(action):
    """Return an action's result and the message of its refusal: one is None, other exceptions are raised."""
    try:
        return action(), None
    except ArmscanError as error:
        return None, str(error)


def is_answered(action):
    """Return whether an action succeeds, or is refused in one line."""
    _, message = outcome(action)
    return message is None or len(message.splitlines()) == 1


def result_of(action):
    """Return the result of an action, None if it is refused, which must be in one line."""
    result, message = outcome(action)
    assert message is None or len(message.splitlines()) == 1
    return result


def is_sound(volume):
    """Return whether a volume is like any other: every landmark is there, and slices can be made."""
    return (
        {1, 2, 3} <= set(np.unique(volume.labels)) <= {0, 1, 2, 3, 4}
        and np.isfinite(volume.spacing).all()
        and min(volume.spacing) > 0
        and volume.slice(ManipulatorAction((10.0, 5.0), (0.0, 1.0))).shape == volume.slice_shape
    )


def write_whole(path, *, is_compressed=False):
    """Write the tiny volume as a file of the kind that its name says."""
    import SimpleITK

    labels = make_tiny_volume().labels
    if path.name == "wrist.seg.nrrd":
        write_segmentation(path, labels, [(name, 0, label) for label, name in enumerate(NAMES, 1)])
    elif path.name == "layers.seg.nrrd":
        layers = np.stack([labels == label for label in (1, 2, 3)]).astype(np.uint8)
        write_segmentation(path, layers, [(name, layer, 1) for layer, name in enumerate(NAMES)])
    else:
        image = SimpleITK.GetImageFromArray(np.ascontiguousarray(labels.T).astype(np.int16))
        image.SetSpacing((0.5, 0.7, 0.9))
        image.SetOrigin((1.0, -2.0, 3.0))
        SimpleITK.WriteImage(image, str(path), is_compressed)


@pytest.fixture(scope="module")
def whole_files(tmp_path_factory):
    """Return the bytes of one whole file of each kind, by name."""
    folder = tmp_path_factory.mktemp("whole")
    for name in FILES:
        write_whole(folder / name)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def laid_out(folder, contents, name, damaged):
    """Write a file, damaged, with the data file of a .mhd header beside it."""
    (folder / "wrist.raw").write_bytes(contents["wrist.raw"])
    (folder / name).write_bytes(damaged)
    return folder / name


@pytest.mark.parametrize("name", [*FILES, "wrist.raw"])
@SETTINGS
@given(kept=st.floats(0, 1, exclude_max=True))
def test_truncated_files_are_refused(tmp_path, whole_files, name, kept):
    contents = whole_files[name]
    path = laid_out(tmp_path, whole_files, name, contents[: int(kept * len(contents))])
    if name == "wrist.raw":
        path = laid_out(tmp_path, whole_files | {name: path.read_bytes()}, "wrist.mhd", whole_files["wrist.mhd"])
    volume = result_of(lambda: read_volume(path))
    # All voxels may be there if only the end of a compressed stream, or of a header, is missing.
    if volume is not None:
        np.testing.assert_array_equal(volume.labels, make_tiny_volume().labels)


@pytest.mark.parametrize("name", FILES)
@SETTINGS
@given(data=st.data())
def test_files_with_flipped_bits_are_read_or_refused(tmp_path, whole_files, name, data):
    damaged = bytearray(whole_files[name])
    # Mostly in the header, where a change matters most.
    for _ in range(data.draw(st.integers(1, 3))):
        position = data.draw(st.integers(0, min(len(damaged), 700) - 1) | st.integers(0, len(damaged) - 1))
        damaged[position] ^= 1 << data.draw(st.integers(0, 7))
    volume = result_of(lambda: read_volume(laid_out(tmp_path, whole_files, name, bytes(damaged))))
    assert volume is None or is_sound(volume)


@pytest.mark.parametrize("name", FILES)
@SETTINGS
@given(contents=st.binary(max_size=400))
def test_files_of_anything_are_refused(tmp_path, whole_files, name, contents):
    assert result_of(lambda: read_volume(laid_out(tmp_path, whole_files, name, contents))) is None
    start = whole_files[name][:100] + contents
    assert is_answered(lambda: read_volume(laid_out(tmp_path, whole_files, name, start)))


ENTRY_KEYS = ["rotation", "translation", "score", "subject", "exclude", "labels", "orientation", "axes", "crop_mm"]
TOP_KEYS = ["labels", "orientation", "axes", "overlap", "spacing", "splits", "volumes"]
manifests = st.dictionaries(
    st.sampled_from(TOP_KEYS) | st.text(max_size=4), values, max_size=3
) | st.fixed_dictionaries(
    {
        "volumes": st.fixed_dictionaries(
            {"a.nii.gz": st.dictionaries(st.sampled_from(ENTRY_KEYS) | st.text(max_size=3), values, max_size=3)}
        )
    }
)


@pytest.mark.parametrize("name", ["manifest.yaml", "manifest.json", "optimal_actions.json"])
@SETTINGS
@given(manifest=manifests | values)
def test_manifests_of_anything_are_read_or_refused(write_labelmap, tmp_path, name, manifest):
    write_labelmap("a.nii.gz")
    text = yaml.safe_dump(manifest) if name.endswith("yaml") else json.dumps(manifest)
    (tmp_path / name).write_text(text, encoding="utf-8")
    assert is_answered(lambda: open_dataset(tmp_path))
    assert is_answered(lambda: record_planes(tmp_path, {"a.nii.gz": (ManipulatorAction((0, 0), (0, 0)), -0.5)}))


@pytest.mark.parametrize("name", ["manifest.yaml", "manifest.json", "optimal_actions.json"])
@SETTINGS
@given(
    contents=st.binary(max_size=60)
    | st.text(alphabet="{}[]:,-!&*<|>'\"#=% \n\tabc019.", max_size=60).map(str.encode)
    | st.sampled_from(["!!int ''", "!!float x", "!!bool x", "!!timestamp x", "=", "&a [*a]", "2020-13-45"]).map(
        lambda text: b"axes: " + text.encode()
    )
)
def test_manifests_of_any_bytes_are_read_or_refused(write_labelmap, tmp_path, name, contents):
    write_labelmap("a.nii.gz")
    (tmp_path / name).write_bytes(contents)
    assert is_answered(lambda: open_dataset(tmp_path))


@SETTINGS
@given(
    changes=st.dictionaries(
        st.sampled_from(["name", "optimal_action", "labels", "orientation", "axes", "crop_mm", "overlap"]),
        anything,
        max_size=2,
    )
)
def test_read_volume_answers_any_argument(write_labelmap, changes):
    volume = result_of(lambda: read_volume(write_labelmap("a.nrrd"), **changes))
    assert volume is None or is_sound(volume)


@SETTINGS
@given(anything)
def test_readers_answer_any_path(path):
    for reader in (read_volume, open_dataset, lambda folder: record_planes(folder, {})):
        assert result_of(lambda reader=reader: reader(path)) is None


@SETTINGS
@given(
    st.dictionaries(
        st.sampled_from(["labels", "spacing", "name", "optimal_action", "origin", "direction"]), anything, min_size=1
    )
)
def test_label_volume_answers_any_argument(changes):
    volume = make_tiny_volume()
    arguments = {"labels": volume.labels, "spacing": (1.0, 1.0, 1.0), "name": "wrist"}
    made = result_of(lambda: LabelVolume(**(arguments | changes)))
    assert made is None or is_sound(made)


@SETTINGS
@given(st.dictionaries(st.sampled_from(["bones", "tendons", "artery", "nerve", "background", "others"]), anything))
def test_label_map_answers_any_argument(arguments):
    assert is_answered(lambda: LabelMap(**({"bones": [1], "tendons": [2], "artery": [3]} | arguments)))
    assert is_answered(lambda: LabelMap.from_mapping(arguments))


@SETTINGS
@given(anything)
def test_record_planes_and_label_map_answer_anything(write_labelmap, received):
    folder = write_labelmap("a.nrrd").parent
    assert is_answered(lambda: record_planes(folder, received))
    assert is_answered(lambda: record_planes(folder, {"a.nrrd": received}))
    assert is_answered(lambda: LabelMap.from_mapping(received))
