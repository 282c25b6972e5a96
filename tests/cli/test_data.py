"""The command that shows what is in a folder of volumes."""

import re
import shutil

import numpy as np
import pytest

from armscan.cli.main import main


@pytest.fixture
def inspected(tmp_path, monkeypatch, capsys):
    """Return a function that inspects the temporary folder and returns what is printed."""
    # Set in the workers of pytest-xdist.
    monkeypatch.delenv("COLUMNS", raising=False)

    def printed():
        assert main(["data", "inspect", str(tmp_path)]) == 0
        return capsys.readouterr().out

    return printed


def test_data_command_tells_what_each_volume_holds(write_labelmap, tmp_path, inspected):
    for name in ("a.nrrd", "b.nrrd", "c.nrrd"):
        write_labelmap(name)
    (tmp_path / "manifest.yaml").write_text(
        "labels: {bones: [1], tendons: [2], artery: [3], nerve: [4]}\n"
        "splits: {train: [S1, b.nrrd]}\n"
        "volumes:\n"
        "  a.nrrd: {subject: S1, crop_mm: {y: [0, 4]}, rotation: [0, 0], translation: [0, 0]}\n"
        "  b.nrrd: {}\n"
        "  c.nrrd: {exclude: '[bold] motion'}\n"
    )
    printed = inspected()
    for part in (
        "a.nrrd: subject S1, for train, a labelled plane",
        "30 x 11 x 12 voxels of 0.3 x 0.4 x 0.5 mm, axes towards LPS; read from 30 x 20 x 12",
        "cropped to y from 0 to 4 mm",
        "b.nrrd: subject b.nrrd, for train, no labelled plane",
        "missing",
        "note: y, along the arm, is not the longest of 9 x 4 x 6 mm; axes in the manifest orders them",
        "c.nrrd: excluded ([bold] motion)",
        "bones",
        "1 (231)",
        "2 volumes of 2 subjects, 1 with a labelled plane",
    ):
        assert part in printed


def test_data_command_notes_a_palm_at_low_z_and_a_plane_that_misses_the_volume(data_folder, tmp_path, inspected):
    volume = next(data_folder.glob("*.nii.gz"))
    shutil.copyfile(volume, tmp_path / volume.name)
    manifest = tmp_path / "manifest.yaml"
    manifest.write_text(f"orientation: LPI\nvolumes: {{{volume.name}: {{rotation: [0, 0], translation: [0, 5000]}}}}\n")
    printed = inspected()
    assert "a labelled plane that misses the volume" in printed
    assert "1 volume of 1 subject, 1 with a labelled plane (1 of them must be corrected, see above)" in printed
    assert "note: the palm is at low z" in printed
    manifest.write_text("orientation: LPS\n")
    assert "note:" not in inspected()


def test_data_command_notes_copies_under_another_subject(write_labelmap, tmp_path, inspected):
    for name in ("a.nrrd", "b.nrrd"):
        write_labelmap(name)
    said = "note: b.nrrd is a copy of a.nrrd: give both the same subject, or remove one"
    assert said in inspected()
    (tmp_path / "manifest.yaml").write_text("volumes: {a.nrrd: {subject: S}, b.nrrd: {subject: S}}")
    assert said not in inspected()


def test_data_command_notes_coarse_voxels_a_size_that_no_arm_has_and_a_plane_without_landmarks(
    write_labelmap, tmp_path, inspected
):
    labels = np.zeros((20, 30, 10), int)
    labels[5:10, 10:20, 2], labels[5:10, 10:20, 5], labels[5:10, 10:12, 8] = 1, 2, 3
    manifest = tmp_path / "manifest.yaml"
    manifest.write_text("volumes: {a.nrrd: {rotation: [0, 0], translation: [0, 15]}}")
    write_labelmap("a.nrrd", labels, (1.0, 1.0, 1.0))
    printed = inspected()
    assert "a.nrrd: subject a.nrrd, a labelled plane that shows no artery\n" in printed
    assert "note: pixels of 1 x 1 mm are coarse" in printed
    assert "mm large" not in printed
    manifest.write_text("spacing: [0.27, 0.27, 0.55]\nvolumes: {a.nrrd: {rotation: [0, 0], translation: [0, 10]}}")
    printed = inspected()
    # It shows all tissues, but not four clusters of bones and three of tendons.
    assert re.search(r"a labelled plane that scores -0.8\d+, and an environment requires more than -0.05\n", printed)
    assert printed.endswith("1 with a labelled plane (1 of them must be corrected, see above)\n")
    assert "note:" not in printed
    write_labelmap("a.nrrd", labels, (0.001, 0.001, 0.001))
    manifest.write_text("{}")
    assert "note: the volume is 0.02 x 0.03 x 0.01 mm large: is the spacing" in inspected()


def test_data_command_needs_no_manifest_and_lists_what_it_does_not_read(write_labelmap, tmp_path, inspected):
    write_labelmap("a.nrrd")
    for name in ("manifst.yaml", "b.nhdr", ".hidden"):
        (tmp_path / name).touch()
    printed = inspected()
    assert "a.nrrd: subject a.nrrd, no labelled plane" in printed
    assert "not read: b.nhdr, manifst.yaml" in printed


def test_data_command_answers_a_mistake_in_one_line(write_labelmap, tmp_path, capsys):
    assert main(["data", "inspect", str(tmp_path / "nowhere")]) == 2
    write_labelmap("a.nrrd")
    for name in ("b.nrrd", "c.nrrd"):
        (tmp_path / name).write_text("damaged")
    assert main(["data", "inspect", str(tmp_path)]) == 2
    of_none, of_two = capsys.readouterr().err.splitlines()
    assert of_none.startswith("error: ")
    assert of_two.startswith(f"error: {tmp_path}/b.nrrd: ")
    assert of_two.endswith("; these cannot be read either: c.nrrd")
