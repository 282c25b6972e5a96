"""Training, validation and test volumes."""

import json
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given

from armscan.errors import InvalidValueError, VolumeError
from armscan.training import Split, mixed_data, nifti_data, phantom_data
from armscan.training.subject_splits import _drawn
from armscan.volumes import LabelVolume, ManipulatorAction
from tests.volumes.test_damaged import SETTINGS, anything, is_answered


def test_phantom_data_has_phantoms_of_other_seeds_for_each_purpose():
    split = phantom_data(n_training=2, n_validation=1, n_test=1, first_seed=5)
    assert list(split.training) == ["phantom-5", "phantom-6"]
    assert list(split.validation) == ["phantom-1000000"]
    assert list(split.test) == ["phantom-2000000"]


def test_phantoms_are_of_the_version_that_the_data_names():
    split = phantom_data(n_training=1, n_validation=1, n_test=1, version=2)
    assert [name for part in split.parts.values() for name in part] == [
        *("phantom-v2-0", "phantom-v2-1000000", "phantom-v2-2000000")
    ]


def test_split_names_volumes_of_files_and_counts_phantoms(folder):
    assert phantom_data(n_training=2, n_validation=1, n_test=1).description is None
    split = mixed_data(folder(), validation="phantoms", test=["V"], n_training=1, n_validation=2)
    assert split.description == (
        "training: a.nrrd, b.nrrd, c.nrrd, d.nrrd, e.nrrd and 1 phantom; validation: 2 phantoms; test: f.nrrd"
    )


def test_wrists_whose_palm_is_on_the_other_side_than_in_phantoms_beside_them_are_noted(folder, monkeypatch):
    mixed = mixed_data(folder(), validation="phantoms", test=["V"], n_training=1, n_validation=2)
    alone = nifti_data(folder())
    for is_high, noted in ((True, False), (False, True)):
        monkeypatch.setattr(LabelVolume, "has_palm_at_high_z", is_high)
        assert bool(mixed.palm_notes) == noted
        assert alone.palm_notes == []
    assert mixed.palm_notes[0].startswith("the palm is at low z in a.nrrd, b.nrrd, c.nrrd, d.nrrd and 2 more, in phan")


@pytest.mark.parametrize(
    "changes",
    [
        {"n_training": 0},
        {"version": 3},
        {"n_validation": 1.5},
        {"n_validation": 10**7},
        {"n_test": 0},
        {"n_test": 2**31},
        {"first_seed": -1},
        {"first_seed": 10**6},
    ],
)
def test_phantom_data_refuses_impossible_numbers(changes):
    with pytest.raises(InvalidValueError, match=r"data\."):
        phantom_data(**({"n_training": 1, "n_validation": 1, "n_test": 1} | changes))


@pytest.fixture
def folder(write_labelmap, tmp_path, tiny_volume):
    """Six volumes of four subjects, no two alike."""
    volumes = {f"{name}.nrrd": {"subject": subject} for name, subject in zip("abcdef", "SSTTUV", strict=True)}
    for number, name in enumerate(volumes):
        write_labelmap(name, np.roll(tiny_volume.labels, number, axis=0))

    def write(**manifest):
        (tmp_path / "manifest.json").write_text(json.dumps({"volumes": volumes} | manifest))
        return str(tmp_path)

    return write


def names(split):
    return tuple("".join(name[0] for name in part) for part in (split.training, split.validation, split.test))


def test_nifti_data_takes_the_splits_of_the_manifest(folder):
    path = folder(splits={"train": ["S", "V"], "validation": ["T"], "test": ["U"]})
    assert names(nifti_data(path)) == ("abf", "cd", "e")


@pytest.mark.parametrize(
    ("validation", "test", "n_subjects"),
    [(None, None, (2, 1, 1)), (0.25, 0.5, (1, 1, 2)), (0.01, 0.26, (1, 1, 2)), (None, 0.5, (1, 1, 2))],
)
def test_nifti_data_draws_shares_of_the_subjects(folder, validation, test, n_subjects):
    split = nifti_data(folder(), validation, test)
    subjects = dict(zip("abcdef", "SSTTUV", strict=True))
    by_part = [{subjects[volume] for volume in part} for part in names(split)]
    assert tuple(map(len, by_part)) == n_subjects
    assert set.union(*by_part) == set("STUV")
    assert sorted("".join(names(split))) == list("abcdef")


def test_nifti_data_draws_the_shares_by_its_seed(folder):
    path = folder()
    drawn = [names(nifti_data(path, split_seed=seed)) for seed in (0, 0, 1, 2, 3)]
    assert drawn[0] == drawn[1]
    assert len(set(drawn)) > 1


@pytest.mark.parametrize(
    ("validation", "test", "expected"),
    [
        ("S", ["U"], ("cdf", "ab", "e")),
        (["a.nrrd", "b.nrrd"], ["V", "e.nrrd"], ("cd", "ab", "ef")),
        (["V"], "f.nrrd", "data.validation and data.test both name f.nrrd|data.test and data.validation both name"),
        ("a.nrrd", "U", "a.nrrd is for validation and b.nrrd for train, but both are of the subject S"),
        ("a.nrrd", "b.nrrd", "a.nrrd is for validation and b.nrrd for test, but both are of the subject S"),
        ("W", None, "data.validation names W, but .* holds a.nrrd, .* or V"),
        ([3], None, r"data.validation is \[3\], but it must be a share, or names"),
        (0.0, None, "data.validation is 0.0, but it must be a share above 0"),
        (1.5, None, "data.validation is 1.5, but it must be a share above 0"),
        (True, None, "data.validation is True, but it must be a share above 0"),
        (None, float("nan"), "data.test is nan, but it must be a share above 0"),
        (0.25, 0.9, "of 0 volumes for training, 0 for validation and 6 for the test, each must be at least 1"),
        ([], None, "0 for validation"),
        (["S", "T", "U"], ["V"], "of 0 volumes for training, 5 for validation and 1 for the test"),
    ],
)
def test_nifti_data_takes_names_of_subjects_and_volumes(folder, validation, test, expected):
    # Arguments take precedence over the manifest.
    path = folder(splits={"train": ["S", "V"], "validation": ["T"], "test": ["U"]})
    if isinstance(expected, tuple):
        assert names(nifti_data(path, validation, test)) == expected
    else:
        with pytest.raises(InvalidValueError, match=expected):
            nifti_data(path, validation, test)


def test_nifti_data_refuses_a_manifest_without_a_split_for_everything(folder):
    with pytest.raises(InvalidValueError, match="of 6 volumes for training, 0 for validation and 0 for the test"):
        nifti_data(folder(splits={"train": ["S", "T", "U", "V"]}))


@pytest.mark.parametrize(
    ("changes", "training"),
    [
        ({}, ["a.nrrd", "b.nrrd", "c.nrrd", "d.nrrd", "e.nrrd", "f.nrrd", "phantom-0"]),
        ({"n_volumes": 2}, ["a.nrrd", "b.nrrd", "phantom-0"]),
        ({"n_volumes": 1, "n_training": 0}, ["a.nrrd"]),
    ],
)
def test_mixed_data_trains_on_the_folder_and_judges_on_phantoms(folder, changes, training):
    split = mixed_data(folder(), **{"n_training": 1, "n_validation": 1, "n_test": 1} | changes)
    assert list(split.training) == training
    assert [*split.validation, *split.test] == ["phantom-1000000", "phantom-2000000"]


@pytest.mark.parametrize("changes", [{"n_volumes": 7}, {"n_volumes": 0}, {"n_training": -1}, {"n_training": None}])
def test_mixed_data_refuses_impossible_numbers(folder, changes):
    with pytest.raises(InvalidValueError, match=r"data\.n_"):
        mixed_data(folder(), **{"n_training": 1, "n_validation": 1, "n_test": 1} | changes)


def test_nifti_data_reads_the_shared_manifest_as_it_is(data_folder):
    assert [len(part) for part in names(nifti_data(str(data_folder)))] == [2, 1, 1]


@SETTINGS
@given(anything, anything, anything)
def test_nifti_data_answers_any_argument(folder, validation, test, split_seed):
    assert is_answered(lambda: nifti_data(folder(), validation, test, split_seed))
    assert is_answered(lambda: nifti_data(folder(), validation="U", test=test))
    assert is_answered(lambda: nifti_data(validation))


@SETTINGS
@given(anything, anything)
def test_split_answers_any_argument(tiny_volume, training, validation):
    assert is_answered(lambda: Split(training, validation, {"a": tiny_volume}))


@pytest.mark.parametrize("volumes", [None, [], {"a": np.zeros(3)}])
def test_split_refuses_what_are_no_volumes(tiny_volume, volumes):
    with pytest.raises(InvalidValueError, match="the validation volumes are"):
        Split({"a": tiny_volume}, volumes, {"b": tiny_volume})


def test_split_refuses_a_copy_of_a_volume_in_another_part(tiny_volume):
    other = replace(tiny_volume, labels=np.roll(tiny_volume.labels, 1, axis=0))
    with pytest.raises(
        InvalidValueError, match=r"c \(test\) is a copy of a \(training\), but a wrist must be in one part"
    ):
        Split({"a": tiny_volume, "b": replace(tiny_volume)}, {"d": other}, {"c": replace(tiny_volume)})


def test_copies_in_one_part_are_of_one_subject(tiny_volume):
    others = [replace(tiny_volume, labels=np.roll(tiny_volume.labels, n, axis=0)) for n in (1, 2)]
    with pytest.raises(VolumeError, match="b is a copy of a, but has another subject"):
        Split({"c": others[0]}, {"d": others[1]}, {"a": tiny_volume, "b": replace(tiny_volume)})
    copies = {name: tiny_volume.of_subject("S") for name in "ab"}
    Split({"c": others[0]}, {"d": others[1]}, copies)


def test_split_refuses_a_copy_that_has_another_plane(tiny_volume):
    other = replace(tiny_volume, labels=np.roll(tiny_volume.labels, 1, axis=0))
    copy = replace(tiny_volume, optimal_action=ManipulatorAction((1.0, 0.0), (0.0, 3.0)))
    with pytest.raises(InvalidValueError, match=r"c \(test\) is a copy of a \(training\)"):
        Split({"a": tiny_volume}, {"b": other}, {"c": copy})
    # Formats store different numbers of digits.
    with pytest.raises(InvalidValueError, match=r"c \(test\) is a copy of a \(training\)"):
        Split({"a": tiny_volume}, {"b": other}, {"c": replace(copy, spacing=np.float32(copy.spacing).tolist())})
    # The same voxels of another size are another wrist's.
    Split({"a": tiny_volume}, {"b": other}, {"c": replace(copy, spacing=(0.5, 0.5, 0.5))})


def test_split_refuses_a_volume_in_two_parts(tiny_volume):
    with pytest.raises(InvalidValueError, match="a is in training and in test"):
        Split({"a": tiny_volume}, {"b": tiny_volume}, {"a": tiny_volume})


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"folds": "leave_one_out", "fold": 0}, ("ef", "cd", "ab")),
        ({"folds": "leave_one_out", "fold": 1}, ("abf", "e", "cd")),
        ({"folds": "leave_one_out", "fold": 3}, ("cde", "ab", "f")),
        ({"folds": "leave_one_out", "fold": 2, "validation": ["S"]}, ("cdf", "ab", "e")),
    ],
)
def test_a_fold_is_tested_on_and_the_next_one_chooses_the_checkpoint(folder, changes, expected):
    # The splits of the manifest are ignored.
    path = folder(splits={"train": ["S", "V"], "validation": ["T"], "test": ["U"]})
    assert names(nifti_data(path, **changes)) == expected


@pytest.mark.parametrize("folds", [2, 3, 4, "leave_one_out"])
def test_every_subject_is_tested_on_in_one_fold(folder, folds):
    n_folds = 4 if folds == "leave_one_out" else folds
    splits = [nifti_data(folder(), folds=folds, fold=fold, validation=0.25, split_seed=5) for fold in range(n_folds)]
    assert sorted(name[0] for split in splits for name in split.test) == list("abcdef")
    if folds == 2:
        drawn = [names(nifti_data(folder(), folds=2, fold=0, validation=0.25, split_seed=seed))[2] for seed in range(6)]
        assert len(set(drawn)) > 1


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"folds": 2, "fold": 0}, "of 0 volumes for training, .* give more subjects, more folds, or data.validation"),
        (
            {"folds": "leave_one_out"},
            r"data.fold is None: give one fold, data\.fold=0 to \d+. armscan run runs every fold",
        ),
        ({"folds": 5, "fold": 0}, r"data.folds is 5, but it must be .* at most 4"),
        ({"folds": 1, "fold": 0}, "data.folds is 1"),
        ({"folds": "loo", "fold": 0}, "data.folds is 'loo', but it must be 'leave_one_out' or a number"),
        ({"folds": 2, "fold": 2}, "data.fold is 2, but it must be .* at most 1"),
        ({"fold": 2}, "data.fold is 2, but data.folds is null"),
        ({"folds": 2, "fold": 0, "test": 0.5}, "data.folds is 2, which says what is tested on, but data.test is 0.5"),
        ({"folds": 2, "fold": 0, "validation": ["S", "T", "U"]}, "data.test|both name"),
    ],
)
def test_impossible_folds_are_refused(folder, changes, line):
    with pytest.raises(InvalidValueError, match=line):
        nifti_data(folder(), **changes)


SMALL_MIX = {"n_training": 1, "n_validation": 1, "n_test": 1}


@pytest.mark.parametrize(
    ("changes", "training", "validation", "test"),
    [
        ({"validation": None, "test": None}, ["a.nrrd", "b.nrrd", "f.nrrd", "phantom-0"], ["cd"], ["e"]),
        (
            {"validation": "phantoms", "test": None},
            ["a.nrrd", "b.nrrd", "c.nrrd", "d.nrrd", "f.nrrd", "phantom-0"],
            ["p"],
            ["e"],
        ),
        (
            {"validation": "phantoms", "test": None, "folds": "leave_one_out", "fold": 3},
            ["a.nrrd", "b.nrrd", "c.nrrd", "d.nrrd", "e.nrrd", "phantom-0"],
            ["p"],
            ["f"],
        ),
        (
            {"validation": None, "test": None, "folds": "leave_one_out", "fold": 0, "n_training": 0},
            ["e.nrrd", "f.nrrd"],
            ["cd"],
            ["ab"],
        ),
        (
            {"validation": None, "test": ["a.nrrd", "b.nrrd"], "n_volumes": 5, "split_seed": 3},
            None,
            None,
            ["ab"],
        ),
    ],
)
def test_mixed_data_is_judged_on_ones_own_subjects_with_phantoms_beside_the_training_alone(
    folder, changes, training, validation, test
):
    path = folder(splits={"train": ["S", "V"], "validation": ["T"], "test": ["U"]})
    split = mixed_data(path, **(SMALL_MIX | changes))
    first = ["".join(name[0] for name in part) for part in (split.validation, split.test)]
    assert [first[1]] == test
    if training is not None:
        assert list(split.training) == training
        assert [first[0]] == validation
    else:
        assert "f.nrrd" not in split.training


@pytest.mark.parametrize(("share", "n_chosen"), [(0.28, 7), (0.29, 8)])
def test_share_of_the_subjects_is_rounded_up_once(share, n_chosen):
    dataset = SimpleNamespace(subjects={f"v{i}": f"S{i}" for i in range(25)})
    parts = _drawn(dataset, {"test": share, "validation": 0.2}, "folder", 0)
    assert Counter(parts.values())["test"] == n_chosen
