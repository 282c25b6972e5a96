"""The command that labels a folder of volumes."""

import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import SimpleITK
from PIL import Image

import armscan.annotation.labelling
from armscan.anatomy import find_optimal_plane
from armscan.cli.main import main
from armscan.envs import ArmscanEnv
from armscan.evaluation.volumes import notes_on_planes
from armscan.volumes import ManipulatorAction, open_dataset, plane_distance, read_markup, read_volume, write_markup
from tests.support.tracked_runs import tracked


@pytest.fixture
def bare(data_folder, tmp_path):
    """Return a folder of two volumes without a manifest."""
    folder = tmp_path / "bare"
    folder.mkdir()
    for path in sorted(data_folder.glob("*.nii.gz"))[:2]:
        shutil.copyfile(path, folder / path.name)
    return folder


@pytest.fixture
def names(bare):
    return sorted(path.name for path in bare.iterdir())


@pytest.fixture
def quick(monkeypatch):
    """Take larger steps than the command does."""
    search = partial(find_optimal_plane, rz_deg=20.0, rx_deg=10.0, step_deg=10.0, step_mm=6.0)
    monkeypatch.setattr(armscan.annotation.labelling, "find_optimal_plane", search)


def refused(words, capsys):
    """Return the one line that answers a mistake."""
    assert main(["data", "label", *words]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    return captured.err.removeprefix("error: ")


def planes(folder):
    return {name: volume.optimal_action for name, volume in open_dataset(folder).volumes.items()}


def test_label_writes_planes_pictures_and_markups_and_says_what_to_do(bare, names, dataset, quick, capsys):
    assert main(["data", "label", str(bare), "--markups"]) == 0
    found = planes(bare)
    for name in names:
        offset_mm, angle_deg = plane_distance(found[name], dataset[name].optimal_action, (48.6, 21.7))
        assert (offset_mm < 6.0, angle_deg < 12.0) == (True, True)
        with Image.open(bare / "labelling" / f"{name}.png") as picture:
            assert picture.size == (860, 512)
        markup = read_markup(bare / "labelling" / f"{name}.mrk.json", dataset[name])
        np.testing.assert_allclose(markup.to_array(), found[name].to_array(), atol=1e-6)
    ArmscanEnv(list(open_dataset(bare).volumes.values()), projection="zy").reset(seed=0)
    said = capsys.readouterr().out
    for word in ("0.000", "4, 3, 1", "accept", "reject", "exclude", "--markup FILE.mrk.json"):
        assert word in said


def test_label_takes_the_planes_that_an_agent_finds(bare, names, database, tmp_path, capsys):
    run_id = tracked(tmp_path, "projection=full")
    store = f"--tracking=sqlite:///{tmp_path}/mlruns.db"
    assert main(["data", "label", str(bare), f"--agent={run_id[:8]}", store, f"--volumes={names[1]}"]) == 0
    assert planes(bare)[names[0]] is None
    assert planes(bare)[names[1]] is not None
    assert "planes written into the manifest" in capsys.readouterr().out
    (note,) = notes_on_planes(str(bare), run_id)
    assert note.startswith(f"this agent has found the labelled planes of {names[1]} itself")
    (note,) = notes_on_planes(str(bare), None)
    assert note == f"agents have found the labelled planes of {names[1]}: distances are from planes of agents"
    assert main(["data", "inspect", str(bare)]) == 0
    assert f" (found by the agent of run {run_id[:8]})" in capsys.readouterr().out
    assert "and its environment holds rz and rx and tx at the labelled plane" in refused(
        [str(bare), f"--agent={tracked(tmp_path)}", store], capsys
    )


def test_label_leaves_planes_that_are_there_unless_told_otherwise(bare, names, quick, capsys):
    pictures = bare / "elsewhere" / "deep"
    assert main(["data", "label", str(bare), f"--volumes={names[0]}", f"--pictures={pictures}"]) == 0
    assert [path.name for path in pictures.iterdir()] == [f"{names[0]}.png"]
    first = planes(bare)[names[0]]
    assert planes(bare)[names[1]] is None
    other = ManipulatorAction((0.0, 0.0), (0.0, 100.0))
    armscan.volumes.record_planes(bare, {names[0]: (other, -0.5)})
    assert main(["data", "label", str(bare)]) == 0
    assert planes(bare)[names[0]] == other
    assert planes(bare)[names[1]] is not None
    capsys.readouterr()
    assert main(["data", "label", str(bare)]) == 0
    assert "every volume has a plane already" in capsys.readouterr().out
    before = (bare / "manifest.yaml").read_bytes()
    assert main(["data", "label", str(bare), f"--volumes={names[0]}", "--overwrite"]) == 0
    assert planes(bare)[names[0]] == first
    (kept,) = bare.glob("manifest.yaml.*.bak")
    assert kept.read_bytes() == before
    assert f"the former planes are kept in {kept}\n" in capsys.readouterr().out


@pytest.mark.parametrize(("clustering", "is_noted"), [("pixels", True), ("metric", False)])
def test_label_notes_voxels_that_are_too_coarse_for_clusters_of_pixels(bare, names, capsys, clustering, is_noted):
    image = SimpleITK.ReadImage(bare / names[0])
    image.SetSpacing((0.5, 0.5, 0.55))
    SimpleITK.WriteImage(image, bare / names[0])
    write_markup(bare / "moved.mrk.json", read_volume(bare / names[0]), ManipulatorAction((0.0, 0.0), (0.0, 20.0)))
    words = [f"--markup={bare}/moved.mrk.json", f"--volume={names[0]}", f"--clustering={clustering}"]
    assert main(["data", "label", str(bare), *words]) == 0
    assert (f"note: {names[0]}: pixels of 0.5 x 0.55 mm are coarse" in capsys.readouterr().out) == is_noted


def test_label_takes_a_plane_that_was_moved_in_slicer(bare, names, capsys):
    volume = read_volume(bare / names[0])
    moved = ManipulatorAction((5.0, -2.0), (0.0, 20.0))
    write_markup(bare / "moved.mrk.json", volume, moved)
    assert main(["data", "label", str(bare), f"--markup={bare}/moved.mrk.json", f"--volume={names[0]}"]) == 0
    np.testing.assert_allclose(planes(bare)[names[0]].to_array(), moved.to_array(), atol=1e-6)
    assert (bare / "labelling" / f"{names[0]}.png").is_file()
    said = capsys.readouterr().out
    assert f"note: {names[0]} scores -" in said


def test_label_goes_on_after_a_volume_without_an_optimal_plane(bare, names, quick, write_labelmap, capsys):
    write_labelmap("bare/0_block.nii.gz")
    assert main(["data", "label", str(bare)]) == 2
    assert planes(bare)["0_block.nii.gz"] is None
    assert all(planes(bare)[name] is not None for name in names)
    captured = capsys.readouterr()
    assert captured.err.startswith("error: 0_block.nii.gz: no plane of ")
    assert captured.err.count("\n") == 1
    assert "planes written into the manifest" in captured.out


def test_label_goes_on_after_a_volume_that_the_clustering_rules_do_not_fit(bare, names, quick, write_labelmap, capsys):
    write_labelmap("bare/0_coarse.nii.gz", spacing=(0.3, 0.4, 1.1))
    assert main(["data", "label", str(bare), "--clustering=metric"]) == 2
    assert all(planes(bare)[name] is not None for name in names)
    assert "error: 0_coarse.nii.gz: eps_mm of label 3 is 0.6" in capsys.readouterr().err


def test_label_keeps_a_markups_file_with_a_plane_that_a_person_has_moved(bare, names, dataset, quick, capsys):
    assert main(["data", "label", str(bare), "--markups"]) == 0
    file, moved = bare / "labelling" / f"{names[0]}.mrk.json", ManipulatorAction((5.0, -2.0), (0.0, 20.0))
    write_markup(file, dataset[names[0]], moved)
    capsys.readouterr()
    for more in ([], ["--overwrite"]):
        assert main(["data", "label", str(bare), "--markups", *more]) == 0
        np.testing.assert_allclose(read_markup(file, dataset[names[0]]).to_array(), moved.to_array(), atol=1e-6)
        said = " ".join(capsys.readouterr().out.split())
        assert said.count("holds another plane, or none, and is left as it is") == 1
    # Moved across, within itself.
    across = replace(moved, translation=(4.0, 20.0))
    write_markup(file, dataset[names[0]], across)
    armscan.volumes.record_planes(bare, {names[0]: (moved, -0.5)})
    assert main(["data", "label", str(bare), "--markups"]) == 0
    np.testing.assert_allclose(read_markup(file, dataset[names[0]]).to_array(), across.to_array(), atol=1e-6)
    damaged = bare / "labelling" / f"{names[1]}.mrk.json"
    damaged.write_text("{")
    assert main(["data", "label", str(bare), "--markups"]) == 0
    assert damaged.read_text() == "{"
    damaged.unlink()
    capsys.readouterr()
    # Once it is read back, it is the manifest's plane.
    assert main(["data", "label", str(bare), f"--volume={names[0]}", f"--markup={file}"]) == 0
    assert main(["data", "label", str(bare), "--markups"]) == 0
    assert "holds another plane" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "Missing argument 'FOLDER'."),
        ([""], "Invalid value for 'FOLDER'"),
        (["x", "y"], "Got unexpected extra argument (y)"),
        (["x", "--planes=3"], "No such option '--planes'"),
        (["x", "--volumes="], "Invalid value for '--volumes': '' has an empty part."),
        (["x", "--volumes=a,,b"], "Invalid value for '--volumes': 'a,,b' has an empty part."),
        (["x", "--overwrite=perhaps"], "Option '--overwrite' does not take a value."),
        (["x", "--clustering=x"], "Invalid value for '--clustering': 'x' is not one of 'pixels', 'metric'."),
        (["x", "--markup=y"], "--markup and --volume must be given together"),
        (["x", "--volume=y"], "--markup and --volume must be given together"),
        (["x", "--markup=y", "--volume=z", "--overwrite"], "--overwrite cannot be combined with"),
        (["x", "--markup=y", "--volume=z", "--agent=a"], "--agent cannot be combined with"),
        (["x", "--trust"], "--tracking and --trust are for --agent"),
        (["x", "--markup=y", "--volume=z", "--volumes=z"], "--volumes cannot be combined with"),
        (["007[${x}"], "007[${x}: the folder of volumes does not exist"),
        (["/no/such/folder"], "/no/such/folder: the folder of volumes does not exist"),
    ],
)
def test_label_answers_a_mistake_in_one_line(words, message, capsys):
    assert message in refused(words, capsys)


def test_label_names_the_volumes_that_it_knows(bare, names, capsys):
    assert f"the volume is 'x', but it must be {names[0]} or {names[1]}" in refused([str(bare), "--volumes=x"], capsys)


def test_label_writes_nowhere_that_a_link_in_the_folder_leads_to(bare, names, quick, capsys, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (bare / "labelling").symlink_to(elsewhere)
    assert "labelling: is a link: name the folder of the pictures" in refused([str(bare)], capsys)
    (bare / "labelling").unlink()
    (bare / "labelling").mkdir()
    picture = bare / "labelling" / f"{names[0]}.png"
    picture.symlink_to(elsewhere / "precious")
    (elsewhere / "precious").write_text("precious")
    assert main(["data", "label", str(bare), f"--volumes={names[0]}"]) == 0
    assert not picture.is_symlink()
    assert (elsewhere / "precious").read_text() == "precious"


def test_label_leaves_no_plane_where_its_picture_cannot_be_written(bare, names, quick, capsys):
    (bare / "file").touch()
    assert "no folder can be made there" in refused([str(bare), f"--pictures={bare}/file"], capsys)
    (bare / "labelling" / f"{names[0]}.png").mkdir(parents=True)
    assert "the picture cannot be written" in refused([str(bare)], capsys)
    assert not (bare / "manifest.yaml").exists()


def test_label_explains_itself(capsys):
    assert main(["data", "label", "--help"]) == 0
    assert "Usage: armscan data label [OPTIONS] FOLDER" in capsys.readouterr().out


def test_label_that_is_interrupted_says_so(bare, monkeypatch, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(armscan.annotation.labelling, "find_optimal_plane", interrupt)
    assert main(["data", "label", str(bare)]) == 130
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.slow
def test_label_finds_the_plane_of_each_labelled_volume(tmp_path, data_folder, more_volumes):
    for path in (*data_folder.glob("*.nii.gz"), *more_volumes.glob("*.nii.gz")):
        shutil.copyfile(path, tmp_path / path.name)
    assert main(["data", "label", str(tmp_path)]) == 0
    labelled = {**open_dataset(data_folder).volumes, **open_dataset(more_volumes).volumes}
    for name, action in planes(tmp_path).items():
        centre_mm = labelled[name].centre_mm
        offset_mm, angle_deg = plane_distance(action, labelled[name].optimal_action, (centre_mm[0], centre_mm[2]))
        assert (offset_mm <= 6.0, angle_deg <= 12.0) == (True, True), name
