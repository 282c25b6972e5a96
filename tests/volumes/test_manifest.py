"""Manifests: what they may contain, what is refused, and how planes are written into them."""

import json
import math
import multiprocessing
import os
import re
from dataclasses import fields

import pytest
import yaml

from armscan.errors import InvalidValueError, ManifestError, VolumeError
from armscan.volumes import LabelMap, ManipulatorAction, open_dataset, record_planes
from armscan.volumes.dataset import planes_found_by
from tests.support import REPOSITORY
from tests.volumes.test_dataset import PLANE

NAMES = ["manifest.yaml", "manifest.yml", "manifest.json"]


@pytest.fixture
def folder(write_labelmap, tmp_path):
    """Two volumes without a manifest."""
    write_labelmap("a.nii.gz")
    write_labelmap("b.nrrd")
    return tmp_path


def written(folder, contents, name="manifest.yaml"):
    text = contents if isinstance(contents, str) else json.dumps(contents)
    (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_manifest_is_read_in_either_language(folder, name):
    written(folder, {"volumes": {"a.nii.gz": {**PLANE, "subject": "S1"}, "b.nrrd": {}}}, name)
    dataset = open_dataset(folder)
    assert dataset.volumes["a.nii.gz"].optimal_action.translation == (0.0, 7.0)
    assert dataset.volumes["b.nrrd"].optimal_action is None
    assert dataset.subjects == {"a.nii.gz": "S1", "b.nrrd": "b.nrrd"}
    assert dataset.splits is None


def test_manifest_without_entries_takes_every_volume(folder):
    assert list(open_dataset(written(folder, "axes: xyz")).volumes) == ["a.nii.gz", "b.nrrd"]


@pytest.mark.parametrize(
    ("subjects", "message"),
    [
        (("S1 ", "S1"), "is 'S1 ', but a subject must not begin or end with a blank"),
        (("Mu\u0308ller", "M\u00fcller"), r"look alike: 'Mu\\u0308ller', 'M\\xfcller'"),
        (("S 1", "S\u00a01"), r"look alike: 'S 1', 'S\\xa01'"),
        (("S1", "S1\u200b"), r"look alike: 'S1', 'S1\\u200b'"),
    ],
)
def test_manifest_refuses_subjects_that_look_alike(folder, subjects, message):
    entries = {name: {"subject": subject} for name, subject in zip(("a.nii.gz", "b.nrrd"), subjects, strict=True)}
    with pytest.raises(ManifestError, match=message):
        open_dataset(written(folder, {"volumes": entries}))


def test_manifest_says_if_a_file_name_has_another_unicode_form(folder):
    (folder / "b.nrrd").rename(folder / "Mu\u0308ller.nrrd")
    with pytest.raises(
        ManifestError, match=r"entry for M\u00fcller\.nrrd, which the folder holds in another Unicode form"
    ):
        open_dataset(written(folder, {"volumes": {"a.nii.gz": {}, "M\u00fcller.nrrd": {}}}))


def test_volumes_that_would_be_left_out_silently_are_refused(folder):
    (folder / "c.nii.gz").symlink_to("annex/c")
    with pytest.raises(VolumeError, match=r"c\.nii\.gz: is a link to 'annex/c', but that file does not exist"):
        open_dataset(written(folder, ""))
    (folder / "c.nii.gz").unlink()
    (folder / "a.nii.gz").rename(folder / "A.NII.GZ")
    with pytest.raises(VolumeError, match=r"A\.NII\.GZ: ends in capitals"):
        open_dataset(folder)


def test_manifest_may_be_missing_where_that_is_said(folder):
    with pytest.raises(ManifestError, match="the folder has no manifest"):
        open_dataset(folder)
    assert list(open_dataset(folder, require_manifest=False).volumes) == ["a.nii.gz", "b.nrrd"]


def test_manifest_that_is_a_pipe_or_a_device_is_refused(folder):
    manifest = folder / "manifest.yaml"
    manifest.unlink(missing_ok=True)
    os.mkfifo(manifest)
    for _ in range(2):
        with pytest.raises(ManifestError, match=r"manifest\.yaml: the manifest is not a file"):
            open_dataset(folder)
        manifest.unlink()
        manifest.symlink_to("/dev/zero")


def test_manifest_stands_alone(folder):
    written(folder, "", "manifest.yaml")
    written(folder, "{}", "optimal_actions.json")
    with pytest.raises(ManifestError, match=r"holds manifest\.yaml and optimal_actions\.json, but one"):
        open_dataset(folder)


def test_manifest_gives_an_entry_precedence(folder):
    written(folder, {"axes": "zyx", "volumes": {"a.nii.gz": {"axes": "xyz"}, "b.nrrd": {}}})
    volumes = open_dataset(folder).volumes
    assert volumes["a.nii.gz"].shape == volumes["b.nrrd"].shape[::-1]


@pytest.mark.parametrize(("value", "reason"), [(True, "True"), ("too short", "too short")])
def test_manifest_excludes_a_volume(folder, value, reason):
    (folder / "b.nrrd").write_text("not even an image")
    written(folder, {"volumes": {"a.nii.gz": {"exclude": False}, "b.nrrd": {"exclude": value}}})
    dataset = open_dataset(folder)
    assert list(dataset.volumes) == ["a.nii.gz"]
    assert dataset.excluded == {"b.nrrd": reason}


def test_manifest_splits_by_subject(folder, write_labelmap):
    write_labelmap("c.nii.gz")
    volumes = {"a.nii.gz": {"subject": "S1"}, "b.nrrd": {"subject": "S2"}, "c.nii.gz": {"subject": "S1"}}
    written(folder, {"splits": {"train": ["S1"], "test": ["S2"]}, "volumes": volumes})
    dataset = open_dataset(folder)
    assert dataset.splits == {"a.nii.gz": "train", "b.nrrd": "test", "c.nii.gz": "train"}
    assert list(dataset.volumes_of("train")) == ["a.nii.gz", "c.nii.gz"]


@pytest.mark.parametrize(
    ("splits", "message"),
    [
        ({"train": ["S1"], "test": ["S2", "S1"]}, r"splits has the subject 'S1' in train and in test"),
        ({"train": ["S1"], "test": ["S2", "S2"]}, r"splits has the subject 'S2' in test and in test"),
        ({"train": ["S1"], "test": ["S3"]}, r"splits names S3, but the subjects are S1, S2"),
        ({"train": ["S1"]}, r"splits does not name 'S2', the subject of b\.nrrd"),
        ({"train": []}, r"splits: a split is \[\], but it must be a list of at least one subject"),
        ({"train": [1]}, r"splits: a split is \[1\], but it must be a list of at least one subject"),
        ({"trian": ["S1"]}, r"splits has the key 'trian', but only train, validation or test"),
        (["S1"], r"splits is \['S1'\], but it must be lists of subjects under train"),
    ],
)
def test_manifest_refuses_impossible_splits(folder, splits, message):
    written(folder, {"splits": splits, "volumes": {"a.nii.gz": {"subject": "S1"}, "b.nrrd": {"subject": "S2"}}})
    with pytest.raises(ManifestError, match=rf"manifest\.yaml: {message}"):
        open_dataset(folder)


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ("volumes: {a.nii.gz: {}, a.nii.gz: {}}", r"cannot be read as YAML \(the key 'a\.nii\.gz' appears twice"),
        ("axes: xyz\naxes: zyx", "the key 'axes' appears twice"),
        ("{unclosed", "cannot be read as YAML"),
        ("!!python/object:os.system {}", "cannot be read as YAML"),
        ("- a", "is a list, but"),
        ("[" * 10_000, "cannot be read as YAML"),
        ("axis: xyz", "has the key 'axis', but only labels, orientation, axes, overlap, spacing, splits or volumes"),
        ("axes: [x, y, z]", r"axes is \['x', 'y', 'z'\], but it must be the letters"),
        ("orientation: LLS", "orientation is 'LLS', but it must be null"),
        ("spacing: coarsest", r"spacing is 'coarsest', but it must be own, finest or \(sx, sy, sz\) in mm"),
        ("spacing: 0.3", r"spacing is 0\.3, but it must be own, finest or \(sx, sy, sz\) in mm"),
        ("spacing: [0.3, 0.3]", r"spacing is \[0\.3, 0\.3\], but it must be 3 finite numbers"),
        ("spacing: [0.3, 0.3, 0]", r"spacing is \[0\.3, 0\.3, 0\.0\], but each must be above 0"),
        ("overlap: none", "overlap is 'none', but it must be refuse, first or last"),
        ("labels: {bones: [1], tendons: [1], artery: [2]}", "labels: 1 is bones and tendons, but"),
        ("labels: {bones: [1], tendons: [2]}", "labels: artery is empty"),
        ("labels: {bones: [1], tendons: [2], artery: []}", "labels: artery is empty"),
        ("labels: {bones: 1, tendons: [2], artery: [3]}", "labels: bones is 1, but it must be a list"),
        ("labels: {bones: [1.5], tendons: [2], artery: [3]}", r"labels: bones is \[1\.5\], but it must be a list"),
        ("labels: {bones: [1], tendons: [2], artery: [3], veins: [4]}", "labels has the key 'veins', but only"),
        ("labels: {bones: [1], tendons: [2], artery: [3], others: x}", "labels: others is 'x', but"),
        ("volumes: [a.nii.gz]", r"volumes is \['a.nii.gz'\], but it must be entries by the names of the files"),
        ("volumes: {a.nii.gz: {subject: 3}}", "entry 'a.nii.gz': subject is 3, but it must be a string"),
        ("volumes: {a.nii.gz: {subject: ''}}", "entry 'a.nii.gz': subject is '', but it must be a string"),
        ("volumes: {a.nii.gz: {exclude: 1}}", "entry 'a.nii.gz': exclude is 1, but it must be true, false or the"),
        (
            "volumes: {a.nii.gz: {exclude: 'no'}}",
            "entry 'a.nii.gz': exclude is 'no', but it must be true, false or the",
        ),
        ("volumes: {a.nii.gz: {exclude: n}}", "entry 'a.nii.gz': exclude is 'n', but it must be true, false or the"),
        ("volumes: {a.nii.gz: {exclude: ''}}", "entry 'a.nii.gz': exclude is '', but it must be true, false or the"),
        ("? ''\n: 1\n? ''\n: 2", "the key '' appears twice"),
        ("volumes: {a.nii.gz: {score: 0.1}}", "entry 'a.nii.gz': score is 0.1, but it must be"),
        ("volumes: {a.nii.gz: {score: .nan}}", "entry 'a.nii.gz': score is nan, but it must be"),
        ("volumes: {a.nii.gz: {rotation: [.inf, 0]}}", r"entry 'a.nii.gz': rotation is \[inf, 0\], but it must be"),
        ("volumes: {a.nii.gz: {translation: [0, 0]}}", "entry 'a.nii.gz' has no rotation, but"),
        ("volumes: {a.nii.gz: {crop_mm: [1, 2]}}", r"entry 'a.nii.gz': crop_mm is \[1, 2\], but it must give"),
        ("volumes: {a.nii.gz: {crop_mm: {y: [3, 2]}}}", r"entry 'a.nii.gz': crop_mm of y is \[3, 2\], but it must"),
        ("volumes: {a.nii.gz: {crop_mm: {w: [3, 2]}}}", r"entry 'a.nii.gz': crop_mm is {'w': \[3, 2\]}, but it must"),
        ("volumes: {a.nii.gz: }", "entry 'a.nii.gz' is None, but it must be an object"),
        ("volumes: {a.nii.gz: {exclude: true}, b.nrrd: {exclude: true}}", "excludes every volume"),
    ],
)
def test_manifest_says_what_is_wrong(folder, contents, message):
    with pytest.raises(ManifestError, match=rf"manifest\.yaml: .*{message}") as caught:
        open_dataset(written(folder, contents))
    assert "\n" not in str(caught.value)


ACTION = ManipulatorAction((3.5, -1.0), (0.0, 12.25))


@pytest.mark.parametrize("name", [*NAMES, "optimal_actions.json"])
def test_record_planes_keeps_what_else_the_manifest_says(folder, name):
    entries = {"a.nii.gz": {"axes": "zyx", **PLANE}, "b.nrrd": PLANE}
    whole = entries if name == "optimal_actions.json" else {"spacing": "own", "volumes": entries}
    path = record_planes(written(folder, whole, name), {"b.nrrd": (ACTION, -0.01)})
    assert path == folder / name
    document = yaml.safe_load(path.read_text()) if "y" in path.suffix else json.loads(path.read_text())
    recorded = {"rotation": [3.5, -1.0], "translation": [0.0, 12.25], "score": -0.01}
    entries["b.nrrd"] = recorded
    assert document == whole
    volumes = open_dataset(folder).volumes
    assert volumes["b.nrrd"].optimal_action == ACTION
    assert volumes["a.nii.gz"].optimal_action.rotation == (1.5, -0.5)
    assert {file.name for file in folder.iterdir()} == {"a.nii.gz", "b.nrrd", name}


def test_manifest_may_repeat_itself_as_yaml_allows(folder):
    written(folder, "\ufeffvolumes: {a.nii.gz: &one {subject: S1, axes: xyz}, b.nrrd: {<<: *one, axes: zyx}}")
    dataset = open_dataset(folder)
    assert dataset.subjects == {"a.nii.gz": "S1", "b.nrrd": "S1"}
    assert dataset.volumes["b.nrrd"].shape == dataset.volumes["a.nii.gz"].shape[::-1]


@pytest.mark.parametrize(
    "text",
    [
        "volumes: {a.nii.gz: &same {subject: S1}, b.nrrd: *same}",
        "volumes:\n  a.nii.gz: &one\n    subject: S1  # left\n  b.nrrd: {<<: *one}\n",
        "volumes:\n  b.nrrd: {<<: &one {subject: S1}}\n  a.nii.gz: *one\n",
    ],
)
def test_record_planes_gives_a_plane_to_no_entry_that_repeats_the_labelled_one(folder, text):
    record_planes(written(folder, text), {"a.nii.gz": (ACTION, -0.01)})
    dataset = open_dataset(folder)
    assert dataset.volumes["a.nii.gz"].optimal_action == ACTION
    assert dataset.volumes["b.nrrd"].optimal_action is None
    assert dataset.subjects == {"a.nii.gz": "S1", "b.nrrd": "S1"}


def test_record_planes_writes_nothing_that_would_be_read_otherwise(folder):
    # ruamel.yaml loses the braces of a mapping with an anchor in a list of merged ones.
    text = "volumes:\n  b.nrrd: {<<: [&one {subject: S1}, {axes: xyz}]}\n  a.nii.gz: *one\n"
    with pytest.raises(ManifestError, match=r"cannot be written .*: write them out"):
        record_planes(written(folder, text), {"b.nrrd": (ACTION, -0.01)})
    assert (folder / "manifest.yaml").read_text() == text


def test_record_planes_keeps_comments_and_small_numbers(folder):
    written(folder, "# ours\nvolumes:\n  a.nii.gz:\n    subject: 'S1'  # left\n    score: -0.5\n  b.nrrd: {}\n")
    action = ManipulatorAction((0.0, 0.0), (1e-05, 2.0))
    text = record_planes(folder, {"a.nii.gz": (action, -1e-05)}).read_text()
    assert text.startswith("# ours\nvolumes:\n  a.nii.gz:\n    subject: 'S1'  # left\n    score: -1.0e-05\n")
    assert open_dataset(folder).volumes["a.nii.gz"].optimal_action == action


def test_record_planes_keeps_the_ends_of_lines(folder):
    (folder / "manifest.yaml").write_bytes(b"# ours\r\nvolumes:\r\n  a.nii.gz: {}\r\n  b.nrrd: {}\r\n")
    contents = record_planes(folder, {"a.nii.gz": (ACTION, -0.01)}).read_bytes()
    assert contents.startswith(b"# ours\r\nvolumes:\r\n")
    assert contents.count(b"\n") == contents.count(b"\r\n")
    assert open_dataset(folder).volumes["a.nii.gz"].optimal_action == ACTION


@pytest.mark.parametrize("contents", [None, "axes: xyz", ""])
def test_record_planes_makes_what_is_missing(folder, contents):
    if contents is not None:
        written(folder, contents)
    assert record_planes(folder, {"a.nii.gz": (ACTION, -0.0)}).name == "manifest.yaml"
    volumes = open_dataset(folder).volumes
    assert volumes["a.nii.gz"].optimal_action == ACTION
    assert volumes["b.nrrd"].optimal_action is None


@pytest.mark.parametrize(
    ("planes", "error", "message"),
    [
        ({"c.nii": (ACTION, 0.0)}, ManifestError, r"a plane is given for c\.nii, but the folder holds a\.nii\.gz, b"),
        ({"a.nii.gz": ACTION}, InvalidValueError, r"the plane of 'a\.nii\.gz' is ManipulatorAction.*, but"),
        ({"a.nii.gz": (ACTION, math.nan)}, InvalidValueError, r"the score of 'a\.nii\.gz' is nan, but"),
        ({"a.nii.gz": (ACTION, 0.5)}, InvalidValueError, r"the score of 'a\.nii\.gz' is 0\.5, but"),
        ([ACTION], InvalidValueError, "planes is"),
    ],
)
def test_record_planes_refuses_what_is_no_plane(folder, planes, error, message):
    with pytest.raises(error, match=message):
        record_planes(folder, planes)
    assert not (folder / "manifest.yaml").exists()


def test_record_planes_leaves_a_damaged_manifest_alone(folder):
    written(folder, "axis: 3")
    with pytest.raises(ManifestError, match="has the key 'axis'"):
        record_planes(folder, {"a.nii.gz": (ACTION, 0.0)})
    assert (folder / "manifest.yaml").read_text() == "axis: 3"


def test_manifest_page_names_every_key_and_its_example_is_one(tmp_path):
    from armscan.volumes.manifest import read_manifest
    from armscan.volumes.manifest_schema import Manifest, Splits, VolumeEntry

    page = (REPOSITORY / "docs" / "manifest.md").read_text()
    keys = [
        *Manifest.model_fields,
        *VolumeEntry.model_fields,
        *Splits.model_fields,
        *(f.name for f in fields(LabelMap)),
    ]
    assert [key for key in keys if f"`{key}`" not in page and f"`{key}:" not in page] == []
    (example,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    manifest = read_manifest(written(tmp_path, example) / "manifest.yaml")
    used = {key for entry in manifest.volumes.values() for key in entry.model_fields_set}
    assert used == set(VolumeEntry.model_fields)


def _record_often(folder, name):
    for rz in range(20):
        record_planes(folder, {name: (ManipulatorAction((float(rz), 0.0), (0.0, 0.0)), 0.0)})


def test_record_planes_of_two_processes_are_both_kept(folder):
    names = ["a.nii.gz", "b.nrrd"]
    writers = [
        multiprocessing.get_context("spawn").Process(target=_record_often, args=(folder, name)) for name in names
    ]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    entries = yaml.safe_load((folder / "manifest.yaml").read_text())["volumes"]
    assert [entries[name]["rotation"] for name in names] == [[19.0, 0.0]] * 2


def test_record_planes_writes_through_a_link_and_keeps_its_permissions(folder, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "manifest.yaml"
    elsewhere.write_text("{}")
    elsewhere.chmod(0o640)
    (folder / "manifest.yaml").symlink_to(elsewhere)
    _record_often(folder, "a.nii.gz")
    assert (folder / "manifest.yaml").is_symlink()
    assert "19.0" in elsewhere.read_text()
    assert elsewhere.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("target", ["missing.yaml", "profile"])
def test_link_of_a_stranger_makes_and_changes_no_file_of_the_user(folder, tmp_path_factory, target):
    home = tmp_path_factory.mktemp("home")
    (home / "profile").write_text("# empty so far\n")
    (folder / "manifest.yaml").symlink_to(home / target)
    with pytest.raises(ManifestError, match=r"manifest\.yaml: is a link to .*, but") as caught:
        record_planes(folder, {"a.nii.gz": (ACTION, 0.0)})
    assert str(home / target) in str(caught.value)
    assert [(file.name, file.read_text()) for file in home.iterdir()] == [("profile", "# empty so far\n")]


@pytest.mark.parametrize("edit", ["crop_mm: {y: [2, 8]}", "axes: yxz"])
def test_plane_of_a_volume_that_is_now_read_otherwise_is_not_written(folder, edit):
    read_with = open_dataset(written(folder, "volumes: {a.nii.gz: {}, b.nrrd: {}}")).manifest
    record_planes(folder, {"b.nrrd": (ACTION, 0.0)}, read_with=read_with)
    record_planes(written(folder, "volumes: {}"), {"b.nrrd": (ACTION, 0.0)}, read_with=read_with)
    text = written(folder, f"volumes: {{a.nii.gz: {{{edit}}}, b.nrrd: {{subject: S1}}}}") / "manifest.yaml"
    with pytest.raises(ManifestError, match=r"its settings for a\.nii\.gz have changed since"):
        record_planes(folder, {"a.nii.gz": (ACTION, 0.0)}, read_with=read_with)
    assert "rotation" not in text.read_text()
    record_planes(folder, {"b.nrrd": (ACTION, 0.0)}, read_with=read_with)


def test_lock_of_a_folder_may_be_held_by_every_user_of_the_cache(folder, tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    monkeypatch.setenv("ARMSCAN_CACHE", str(cache))
    record_planes(folder, {"a.nii.gz": (ACTION, 0.0)})
    (lock,) = cache.glob("*.lock")
    assert lock.stat().st_mode & 0o777 == 0o666
    lock.unlink()
    lock.mkdir()
    with pytest.raises(ManifestError, match=r"\.lock: the manifest of .* cannot be locked \(Is a directory"):
        record_planes(folder, {"a.nii.gz": (ACTION, 0.0)})


@pytest.mark.parametrize("number", ["0x" + "F" * 900, "0x" + "F" * 6000, "1:" * 400 + "1", "1:" * 5000 + "1"])
def test_manifest_with_a_huge_number_is_refused_in_one_line(folder, number):
    for key in ("subject", "score", "rotation"):
        with pytest.raises(ManifestError) as caught:
            open_dataset(written(folder, f"volumes: {{b.nrrd: {{{key}: {number}}}, a.nii.gz: {{{key}: [{number}]}}}}"))
        assert len(str(caught.value)) < 2000


def test_manifest_that_is_no_yaml_is_answered_with_the_place(folder):
    (folder / "manifest.yaml").write_text("volumes:\n  a.nii.gz: {exclude: bad: motion}\n")
    with pytest.raises(ManifestError, match=r"as YAML \(did not find expected .* in line 2, column \d+\)"):
        open_dataset(folder)


@pytest.mark.parametrize("name", ["manifest.yaml", "manifest.json"])
def test_plane_that_an_agent_has_found_names_it_until_another_is_recorded(folder, name):
    (folder / name).write_text('{"volumes": {"a.nii.gz": {"subject": "S1"}, "b.nrrd": {}}}')
    record_planes(folder, {"a.nii.gz": (ACTION, -0.1)}, found_by="0a1b")
    assert open_dataset(folder).found_by == planes_found_by(folder) == {"a.nii.gz": "0a1b"}
    record_planes(folder, {"a.nii.gz": (ACTION, -0.1)})
    dataset = open_dataset(folder)
    assert (dataset.found_by, dataset.subjects["a.nii.gz"]) == ({}, "S1")
