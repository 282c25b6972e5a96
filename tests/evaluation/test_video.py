"""`armscan evaluate --video`, as a user types it, on real tracked runs."""

import json
import re
from functools import partial

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageChops

from armscan.training import load_checkpoint, save_checkpoint
from tests.support.refusals import assert_refused
from tests.support.tracked_runs import GUESSER, ON_FILES, store_of, tracked

EPISODE = re.compile(r"^(.+): (\S+), seed (\d+): (no )?success after (\d+) steps?, ([\d.]+) mm", re.MULTILINE)
GUESSER_OF_ANYTHING = ["--agent=sac", "~agent.network", "agent._target_=tests.support.tracked_runs.GuesserOfAnything"]


@pytest.fixture
def record(evaluate):
    """Run `armscan evaluate --video`, as `evaluate` does."""
    return partial(evaluate, "--video")


def gif_frames(file):
    with Image.open(file) as video:
        frames = []
        for number in range(video.n_frames):
            video.seek(number)
            frames.append((video.info["duration"], video.convert("RGB")))
    return frames


def mp4_frames(file):
    reader = imageio_ffmpeg.read_frames(str(file))
    facts = next(reader)
    width, height = facts["size"]
    return facts, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def difference(one, other):
    """Return the mean absolute difference of two pictures, from 0 to 255."""
    return np.asarray(ImageChops.difference(one, other)).mean()


def test_video_is_of_the_episodes_of_an_evaluation_frame_by_frame_in_both_files(record, evaluate, tmp_path):
    run_id = tracked(tmp_path, "projection=zy")
    code, printed, errors = record(run_id[:8], "--episodes=2", "--seed=4", "--max-steps=3")
    assert (code, errors) == (0, "")
    told = EPISODE.findall(printed)
    assert [(label, volume, seed) for label, volume, seed, *_ in told] == [
        ("test volumes", "phantom-2000000", "4"),
        ("test volumes", "phantom-2000000", "5"),
    ]
    words = [run_id, "--episodes=2", "--seed=4", "--max-steps=3", "--out=a.json"]
    assert evaluate(*words)[0] == 0
    episodes = json.loads((tmp_path / "a.json").read_text())["episodes"]["test volumes"]
    n_steps = [each["n_steps"] for each in episodes]
    assert [int(steps) for *_, steps, _ in told] == n_steps
    assert [float(mm) for *_, mm in told] == [round(each["distance_mm"], 1) for each in episodes]
    name = f"videos/tiny-configured-volumes-{run_id[:8]}-seed4-max_steps-3"
    assert printed.endswith(f"look at   {name}.gif\nlook at   {name}.mp4\n")
    frames = gif_frames(tmp_path / f"{name}.gif")
    durations = [ms for steps in n_steps for ms in [*steps * [600], 2400]]
    assert [ms for ms, _ in frames] == durations
    facts, pictures = mp4_frames(tmp_path / f"{name}.mp4")
    assert (facts["codec"], facts["pix_fmt"].partition("(")[0], facts["size"]) == ("h264", "yuv420p", (860, 512))
    assert len(pictures) == sum(ms // 100 for ms in durations)
    # Each frame of the GIF is in the MP4 at its time; frames of other steps differ by more.
    at = 0
    for ms, frame in frames:
        same = Image.fromarray(pictures[at + ms // 200])
        others = [other for _, other in frames if other is not frame]
        assert difference(frame, same) < min(difference(other, same) for other in others)
        at += ms // 100


def test_video_goes_over_every_split_of_a_folder_and_says_what_is_known(record, tmp_path, wrists):
    run_id = tracked(tmp_path, "projection=zy", agent=GUESSER, **ON_FILES)
    code, printed, errors = record(run_id, "--trust", "--data=wrists", "--episodes=1", "--out=elsewhere/videos")
    assert (code, errors) == (0, "")
    assert "note: the agent was trained on these volumes: " in printed
    assert [label for label, *_ in EPISODE.findall(printed)] == ["train split", "validation split", "test split"]
    assert {file.suffix for file in (tmp_path / "elsewhere" / "videos").iterdir()} == {".gif", ".mp4"}


def test_baseline_is_recorded_without_a_store(record, tmp_path):
    (tmp_path / "mlruns.db").unlink()
    words = [*GUESSER_OF_ANYTHING, "--data=phantom", "--phantoms=2", "--max-steps=2"]
    code, printed, errors = record(*words)
    assert (code, errors) == (0, "")
    assert [volume for _, volume, *_ in EPISODE.findall(printed)] == [
        *("phantom-3000000", "phantom-3000001", "phantom-3000000")
    ]
    assert {file.name for file in (tmp_path / "videos").iterdir()} == {
        f"sac-phantom-seed0-max_steps-2{suffix}" for suffix in (".gif", ".mp4")
    }
    assert not (tmp_path / "mlruns.db").exists()


def test_checkpoints_that_are_gone_or_damaged_or_anothers_are_refused(record, tmp_path):
    run_id = tracked(tmp_path, kept=("config.yaml", "volumes.json"))
    assert_refused(record(run_id), f"run {run_id} stored no checkpoint: nothing to evaluate")
    client = store_of(tmp_path)
    weights, facts = load_checkpoint(tmp_path / "best.pt")
    whole = (tmp_path / "best.pt").read_bytes()
    for change, line in (
        (lambda file: file.write_bytes(whole[: len(whole) // 2]), "best.pt: is damaged"),
        (lambda file: file.write_bytes(whole.replace(b"0", b"1")), "best.pt: is damaged"),
        (lambda file: save_checkpoint(file, weights, facts | {"run_id": "5f"}), "best.pt: is a checkpoint of run '5f'"),
    ):
        change(tmp_path / "best.pt")
        client.log_artifact(run_id, str(tmp_path / "best.pt"))
        assert_refused(record(run_id), f"run {run_id}: {line}")
    assert not (tmp_path / "videos").exists()
