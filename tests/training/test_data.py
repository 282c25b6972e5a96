"""Which volumes are trained on, and which are held out."""

import pytest

from armscan.errors import InvalidValueError
from armscan.training import nifti_data, phantom_data


def test_phantom_data_holds_out_phantoms_of_other_seeds():
    split = phantom_data(n_training=2, n_held_out=1, first_seed=5)
    assert list(split.training) == ["phantom-5", "phantom-6"]
    assert list(split.held_out) == ["phantom-1000000"]


@pytest.mark.parametrize("changes", [{"n_training": 0}, {"n_held_out": 1.5}, {"first_seed": -1}, {"first_seed": 10**6}])
def test_phantom_data_refuses_impossible_numbers(changes):
    with pytest.raises(InvalidValueError, match=r"data\."):
        phantom_data(**({"n_training": 1, "n_held_out": 1} | changes))


@pytest.mark.parametrize(("held_out", "n_held_out"), [(0.25, 1), (0.5, 2), (0.51, 3), (0.01, 1)])
def test_nifti_data_holds_out_a_share_of_the_volumes(data_folder, held_out, n_held_out):
    split = nifti_data(str(data_folder), held_out)
    assert len(split.held_out) == n_held_out
    assert len(split.training) == 4 - n_held_out
    assert not split.training.keys() & split.held_out.keys()


def test_nifti_data_draws_the_share_by_its_seed(data_folder):
    drawn = [tuple(nifti_data(str(data_folder), 0.5, split_seed=seed).held_out) for seed in (0, 0, 1, 2, 3)]
    assert drawn[0] == drawn[1]
    assert len(set(drawn)) > 1


@pytest.mark.parametrize("held_out", ["00002_labels.nii.gz", ["00002_labels.nii.gz"]])
def test_nifti_data_holds_out_the_named_volumes(data_folder, held_out):
    assert list(nifti_data(str(data_folder), held_out).held_out) == ["00002_labels.nii.gz"]


@pytest.mark.parametrize(
    ("held_out", "message"),
    [
        (0.0, r"data\.held_out is 0\.0"),
        (1.0, r"data\.held_out is 1\.0"),
        (0.9, "leaves 0 of the 4 volumes"),
        ([], "leaves 4 of the 4 volumes"),
        (["nobody.nii"], r"names nobody\.nii, but .* holds 00001_labels"),
    ],
)
def test_nifti_data_refuses_to_leave_nothing(data_folder, held_out, message):
    with pytest.raises(InvalidValueError, match=message):
        nifti_data(str(data_folder), held_out)
