"""The volumes of an evaluation: those of the run, changed ones, and others of which some are known."""

import json
import shutil

import pytest
import yaml

from armscan.evaluation.volumes import file_name
from tests.support.tracked_runs import GUESSER, ON_FILES, tracked, written


def swapped(manifest):
    """Return a manifest with training and test volumes exchanged."""
    splits = manifest["splits"]
    return manifest | {"splits": splits | {"train": splits["test"], "test": splits["train"]}}


def test_own_volumes_are_those_of_the_folder_that_the_run_was_started_in(evaluate, tmp_path, wrists):
    run_id = tracked(tmp_path, "projection=zy", agent=GUESSER, **ON_FILES)
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(wrists, elsewhere / "wrists")
    manifest = yaml.safe_load((wrists / "manifest.yaml").read_text())
    (elsewhere / "wrists" / "manifest.yaml").write_text(yaml.safe_dump(swapped(manifest)))
    words = [run_id, "--trust", "--episodes=2", f"--tracking=sqlite:///{tmp_path}/mlruns.db", "--out=a.json"]
    code, _, errors = evaluate(*words, cwd=elsewhere)
    assert (code, errors) == (0, "")
    assert list(json.loads((elsewhere / "a.json").read_text())["volumes"]["test volumes"]) == manifest["splits"]["test"]
    wrists.rename(tmp_path / "away")
    code, _, errors = evaluate(*words, cwd=elsewhere)
    assert code == 2
    assert errors.startswith(
        f"error: the volumes of run {run_id} cannot be read: {wrists}: the folder of volumes does not"
    )
    assert f"it was started in {tmp_path}" in errors


@pytest.mark.parametrize("reward", ["published", "agreement"])
def test_own_volumes_that_have_changed_are_refused_where_they_matter(evaluate, tmp_path, wrists, reward):
    run_id = tracked(tmp_path, f"reward={reward}", "projection=zy", agent=GUESSER, **ON_FILES)
    manifest = yaml.safe_load((wrists / "manifest.yaml").read_text())
    (wrists / "manifest.yaml").write_text(yaml.safe_dump(swapped(manifest)))
    line = f"the training volumes are not those that run {run_id} was started with: "
    code, _, errors = evaluate(run_id, "--trust", "--episodes=2")
    assert code == 2
    assert errors.startswith(f"error: {line}")
    code, printed, errors = evaluate(run_id, "--trust", "--data=wrists", "--episodes=4")
    if reward == "agreement":
        assert code == 2
        assert errors.startswith(
            "error: the reward is fitted to the volumes that the agent was trained on, but they cannot be read: "
        )
        assert line in errors
    else:
        assert (code, errors) == (0, "")
        known = ", ".join(manifest["splits"]["train"])
        assert f"note: the agent was trained on these volumes: {known}\n" in printed
        assert "has used some of these volumes, so this is no result on new wrists" in " ".join(printed.split())
        # They are never pooled with others, and the page says so, too.
        assert "all volumes" not in written(tmp_path)["splits"]
        (page,) = (tmp_path / "evaluations").glob("*.html")
        assert f"<p>the agent was trained on these volumes: {known}</p>" in page.read_text()


def test_volumes_of_the_training_are_known_under_other_names_and_others_under_theirs(evaluate, tmp_path, wrists):
    run_id = tracked(tmp_path, agent=GUESSER, **ON_FILES)
    manifest = yaml.safe_load((wrists / "manifest.yaml").read_text())
    one, _, third, last = manifest["volumes"]
    copies = tmp_path / "copies"
    copies.mkdir()
    # A training volume under another name, and a test volume under the name of a validation volume.
    for name, copy in {one: "copy.nii.gz", last: third}.items():
        shutil.copy(wrists / name, copies / copy)
    entries = {"copy.nii.gz": manifest["volumes"][one], third: manifest["volumes"][last]}
    (copies / "manifest.yaml").write_text(yaml.safe_dump({"volumes": entries}))
    code, printed, errors = evaluate(run_id, "--trust", "--data=copies", "--episodes=2")
    assert (code, errors) == (0, "")
    assert f"note: the agent was trained on these volumes: copy.nii.gz (there {one})\n" in printed
    assert "note: the agent's checkpoint was chosen on volumes of these names, but with other voxels" in printed
    assert f"or another plane: {third}\n" in printed


def test_another_volume_of_a_subject_of_the_training_is_known(evaluate, tmp_path, wrists):
    manifest = yaml.safe_load((wrists / "manifest.yaml").read_text())
    one, _, _, last = manifest["volumes"]
    manifest["volumes"][one]["subject"] = "anna"
    manifest["splits"]["train"] = ["anna", *manifest["splits"]["train"][1:]]
    (wrists / "manifest.yaml").write_text(yaml.safe_dump(manifest))
    run_id = tracked(tmp_path, agent=GUESSER, **ON_FILES)
    other = tmp_path / "other"
    other.mkdir()
    shutil.copy(wrists / last, other / "again.nii.gz")
    entries = {"again.nii.gz": manifest["volumes"][last] | {"subject": "anna"}}
    (other / "manifest.yaml").write_text(yaml.safe_dump({"volumes": entries}))
    code, printed, errors = evaluate(run_id, "--trust", "--data=other", "--episodes=2")
    assert (code, errors) == (0, "")
    assert "note: the agent was trained on other volumes of the same subjects as: again.nii.gz\n" in printed


def test_file_names_of_long_names_are_short_and_stay_apart():
    names = {file_name("random", f"{'v' * 230}{number}", "seed0") for number in range(3)}
    assert len(names) == 3
    assert max(map(len, names)) < 100
    assert file_name("my run", "ü" * 80).isprintable()


def test_phantoms_are_of_the_version_that_the_run_was_trained_on(evaluate, tmp_path):
    run_id = tracked(tmp_path, "projection=zy", "data.version=2", agent=GUESSER)
    code, _, errors = evaluate(run_id, "--trust", "--data=phantom", "--phantoms=1", "--episodes=1")
    assert (code, errors) == (0, "")
    volumes = written(tmp_path)["volumes"]
    assert {label: list(names) for label, names in volumes.items()} == {
        "new phantoms of version 2": ["phantom-v2-3000000"]
    }


def test_run_without_fingerprints_is_evaluated_with_a_note(evaluate, tmp_path):
    run_id = tracked(tmp_path, agent=GUESSER, kept=("config.yaml",))
    code, printed, _ = evaluate(run_id, "--trust", "--episodes=1")
    assert code == 0
    assert "note: the run has no fingerprints of its volumes" in printed
    code, printed, _ = evaluate(run_id, "--trust", "--data=phantom", "--phantoms=1", "--episodes=1")
    assert code == 0
    assert "note: the run has no fingerprints" not in printed
