"""3D Slicer's segmentations."""

from pathlib import Path

import nrrd
import numpy as np
import pytest
import slicerio

from armscan.errors import VolumeError
from armscan.volumes import LabelMap, open_dataset, read_volume

# Saved by 3D Slicer; the package carries them for its own tests.
SLICER_FILES = Path(slicerio.__file__).parent / "data"
NAMES = ("Bones", "tendons", "ARTERY")
# In LPS: the three axes run towards posterior, inferior and left.
DIRECTIONS = np.array([[0.0, 0.5, 0.0], [0.0, 0.0, -0.7], [0.9, 0.0, 0.0]])


def write_segmentation(path, layers, segments, *, without=(), directions=DIRECTIONS, **fields):
    """Write voxels over (i, j, k) or (layer, i, j, k) with segments (name, layer, value) as 3D Slicer does."""
    is_layered = layers.ndim == 4
    header = {
        "space": "left-posterior-superior",
        "kinds": ["list"] * is_layered + ["domain"] * 3,
        "space directions": np.vstack([np.full((1, 3), np.nan), directions]) if is_layered else directions,
        "space origin": np.array([10.0, -20.0, 30.0]),
        "encoding": "gzip",
        "Segmentation_MasterRepresentation": "Binary labelmap",
    }
    for position, (name, layer, value) in enumerate(segments):
        header |= {f"Segment{position}_ID": f"Segment_{position + 1}", f"Segment{position}_Name": name}
        header |= {f"Segment{position}_Layer": str(layer), f"Segment{position}_LabelValue": str(value)}
    header |= fields
    nrrd.write(str(path), layers, {key: value for key, value in header.items() if key not in without})
    return path


@pytest.fixture
def stored(tmp_path, tiny_volume):
    """Return the small block as three segments of one layer."""
    segments = [(name, 0, label) for label, name in enumerate(NAMES, 1)]
    return write_segmentation(tmp_path / "wrist.seg.nrrd", tiny_volume.labels, segments)


@pytest.fixture
def layered(tmp_path, tiny_volume):
    """Return the small block in four layers: two bones that overlap, and a muscle that overlaps a tendon."""
    labels = tiny_volume.labels
    first, second = labels == 1, labels == 1
    first[8:], second[:7] = False, False
    muscle = np.where(np.roll(labels == 2, 3, axis=0), 5, 0).astype(np.uint8)
    rest = np.where(labels > 1, labels, 0)
    layers = np.stack([first, second, rest, muscle]).astype(np.uint8)
    segments = [("scaphoid", 0, 1), ("lunate", 1, 1), ("flexors", 2, 2), ("a. ulnaris", 2, 3), ("muscle", 3, 5)]
    return write_segmentation(tmp_path / "wrist.seg.nrrd", layers, segments)


def layered_map(**changes):
    names = {"bones": ["scaphoid", "lunate"], "tendons": ["flexors"], "artery": ["a. ulnaris"]}
    return LabelMap(**(names | changes))


def test_segments_called_like_the_tissues_need_no_map(stored, tiny_volume):
    volume = read_volume(stored)
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels)
    assert volume.spacing == pytest.approx((0.5, 0.7, 0.9))


def test_names_of_segments_may_have_letters_beyond_ascii(tmp_path, tiny_volume):
    labels = LabelMap(bones=["Trap\u00e8ze"], tendons=["\u817f"], artery=["Arterie"])
    path = write_segmentation(
        tmp_path / "a.seg.nrrd", tiny_volume.labels, [("Trap_e", 0, 1), ("tendon", 0, 2), ("Arterie", 0, 3)]
    )
    stored = path.read_bytes()
    path.write_bytes(stored.replace(b"Trap_e", "Trap\u00e8ze".encode()).replace(b":=tendon", b":=" + "\u817f".encode()))
    np.testing.assert_array_equal(read_volume(path, labels=labels).labels, tiny_volume.labels)
    path.write_bytes(stored.replace(b"Trap_e", "Trap\u00e8ze".encode("latin-1")))
    with pytest.raises(
        VolumeError, match=r"has the segment 'Trap\\udce8ze', but a name must be printable text in UTF-8"
    ):
        read_volume(path, labels=labels)


def test_segmentation_lies_where_simpleitk_puts_it(stored):
    import SimpleITK

    image, volume = SimpleITK.ReadImage(str(stored)), read_volume(stored)
    assert volume.spacing == pytest.approx(image.GetSpacing())
    assert volume.origin == pytest.approx(image.GetOrigin())
    np.testing.assert_allclose(volume.direction.ravel(), image.GetDirection(), atol=1e-12)


def test_segments_are_mapped_by_name(stored, tiny_volume):
    volume = read_volume(stored, labels=LabelMap(["Bones"], ["tendons"], ["ARTERY"]), axes="yxz")
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels.transpose(1, 0, 2))


def test_segments_that_are_not_mapped_are_named(layered):
    with pytest.raises(VolumeError, match=r"wrist\.seg\.nrrd: has the segments 'muscle', which the label map does not"):
        read_volume(layered, labels=layered_map())
    with pytest.raises(VolumeError, match=r"'scaphoid', .*'muscle', but without a label map they must be called"):
        read_volume(layered)


def test_segments_of_one_tissue_and_of_none_may_overlap(layered, tiny_volume):
    volume = read_volume(layered, labels=layered_map(others="background"))
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels)


def test_segments_of_two_tissues_that_overlap_are_refused_by_name(layered):
    with pytest.raises(VolumeError, match=r"the segments 'flexors' and 'muscle' overlap, .*overlap: first or last"):
        read_volume(layered, labels=layered_map(nerve=["muscle"]))


@pytest.mark.parametrize("overlap", ["first", "last"])
def test_overlapping_segments_are_resolved_by_the_stated_rule(layered, tiny_volume, overlap):
    volume = read_volume(layered, labels=layered_map(nerve=["muscle"]), overlap=overlap)
    tendon, muscle = tiny_volume.labels == 2, np.roll(tiny_volume.labels == 2, 3, axis=0)
    free = tiny_volume.labels == 0
    np.testing.assert_array_equal(volume.labels == 4, muscle & (free if overlap == "first" else True))
    np.testing.assert_array_equal(volume.labels == 2, tendon if overlap == "first" else tendon & ~muscle)


def test_manifest_states_the_rule_and_reports_the_segments(layered):
    (layered.parent / "manifest.yaml").write_text(
        "overlap: first\n"
        "labels: {bones: [scaphoid, lunate, hamate, 7], tendons: [flexors], artery: [a. ulnaris], nerve: [muscle]}"
    )
    report = open_dataset(layered.parent).reports["wrist.seg.nrrd"]
    assert [each.source for each in report.stored.found] == ["scaphoid", "lunate", "flexors", "a. ulnaris", "muscle"]
    assert report.stored.missing == ("hamate",)


def test_segmentation_of_an_older_slicer_has_a_layer_a_segment(tmp_path, tiny_volume):
    layers = np.stack([tiny_volume.labels == label for label in (1, 2, 3)]).astype(np.uint8)
    without = [f"Segment{position}_{field}" for position in range(3) for field in ("Layer", "LabelValue")]
    segments = [(name, None, None) for name in NAMES]
    volume = read_volume(write_segmentation(tmp_path / "old.seg.nrrd", layers, segments, without=without))
    np.testing.assert_array_equal(volume.labels, tiny_volume.labels)


@pytest.mark.parametrize(
    ("segments", "changes", "message"),
    [
        ([("bones", 0, 1), ("tendons", 0, 2)], {}, "holds 3 in layer 0, but no segment has that value there"),
        ([("bones", 0, 1), ("tendons", 0, 1)], {}, "segment 'tendons' has the value 1 in layer 0, but it must have"),
        ([("bones", 0, 0)], {}, "segment 'bones' has the value 0"),
        ([("bones", 2, 1)], {}, "segment 'bones' has the value 1 in layer 2, but"),
        ([("bones", "x", 1)], {}, "truncated or damaged"),
        ([], {}, "names no segment"),
        ([("bones", 0, 1)], {"without": ["space directions"]}, "gives no spacing"),
        ([("bones", 0, 1)], {"space": "scanner-xyz"}, "space is scanner-xyz, which does not say"),
        ([("bones", 0, 1)], {"space": "LPS"}, "space is LPS, but a segmentation's is left-posterior-superior or right"),
        ([("bones", 0, 1)], {"without": ["space"]}, "gives no space"),
        ([("bones", 0, 1)], {"without": ["space origin"]}, "gives no space origin"),
        (
            [(name, 0, i) for i, name in enumerate(NAMES, 1)],
            {"directions": DIRECTIONS @ [[1, 0.3, 0], [0, 1, 0], [0, 0, 1]]},
            "right angles",
        ),
        (
            [(name, 0, i) for i, name in enumerate(NAMES, 1)],
            {"directions": DIRECTIONS * [[1], [0], [1]]},
            "spacing in the file",
        ),
    ],
)
def test_damaged_segmentations_are_refused(tmp_path, tiny_volume, segments, changes, message):
    path = write_segmentation(tmp_path / "wrist.seg.nrrd", tiny_volume.labels, segments, **changes)
    with pytest.raises(VolumeError, match=rf"wrist\.seg\.nrrd: .*{message}"):
        read_volume(path)


RIBS = {"bones": ["ribs"], "tendons": ["right lung", "left lung"]}


def test_a_real_segmentation_is_read_by_segment_names():
    import SimpleITK

    path = SLICER_FILES / "Segmentation.seg.nrrd"
    volume = read_volume(path, labels=LabelMap(**RIBS, artery=["tissue"], others="background"))
    stored = SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(path))).transpose(2, 1, 0)
    for label, values in {1: [1], 2: [5, 6], 3: [7]}.items():
        np.testing.assert_array_equal(volume.labels == label, np.isin(stored, values))
    assert read_volume(path, labels=LabelMap(**RIBS, artery=["tissue"], others="background"), orientation="RAS")


def test_a_real_segmentation_with_overlapping_segments_is_refused_or_resolved():
    path = SLICER_FILES / "SegmentationOverlapping.seg.nrrd"
    labels = LabelMap(**RIBS, artery=["overlapping sphere"], others="background")
    with pytest.raises(VolumeError, match=r"the segments '.*' and 'overlapping sphere' overlap"):
        read_volume(path, labels=labels)
    first, last = (read_volume(path, labels=labels, overlap=rule) for rule in ("first", "last"))
    assert (first.labels == 3).sum() < (last.labels == 3).sum()
    assert (first.labels == 2).sum() > (last.labels == 2).sum()
