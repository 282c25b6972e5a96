"""A video of an agent, as a GIF and an MP4."""

from __future__ import annotations

import shutil
import tempfile
from functools import partial
from pathlib import Path

from armscan.evaluation.runner import PreparedAgent
from armscan.evaluation.volumes import check_out, data_name, file_name
from armscan.training import TEST, VideoRecorder, outcome
from armscan.training.episode_seeds import EVALUATION_SEED
from armscan.utils.files import atomic_write
from armscan.utils.run_files import ID_CHARS

FOLDER = Path("videos")
SUFFIXES = (".gif", ".mp4")


def record_video(prepared: PreparedAgent, *, n_episodes: int, seed: int, out: Path | None) -> list[Path]:
    """Record the episodes that an evaluation with the same seed plays, and print how each went.

    Args:
        prepared: Agent on its volumes; of its own volumes, only the test volumes are shown.
        n_episodes: Number of episodes for each group of volumes.
        seed: Seed of the evaluation, which the seeds of its episodes follow from.
        out: Folder of the files; None: `videos`.

    Returns:
        The GIF and the MP4.
    """
    folder = out or FOLDER
    check_out(folder / "video", folder, "video")
    source = prepared.source
    which = [source.run.run_id[:ID_CHARS]] if source.run else []
    name = file_name(source.name, data_name(prepared.data), *which, "-".join([f"seed{seed}", *source.changed_rules]))
    files = [folder / f"{name}{suffix}" for suffix in SUFFIXES]
    with tempfile.TemporaryDirectory() as made_in:
        made = [Path(made_in) / f"video{suffix}" for suffix in SUFFIXES]
        _record(prepared, n_episodes, seed, *made)
        for recorded, file in zip(made, files, strict=True):
            with recorded.open("rb") as contents:
                atomic_write(file, partial(shutil.copyfileobj, contents), follow_link=True)
    return files


def _record(prepared: PreparedAgent, n_episodes: int, seed: int, gif: Path, mp4: Path) -> None:
    envs = prepared.envs
    shown = envs if prepared.data else {TEST: envs[TEST]}
    with VideoRecorder(gif, mp4) as video:
        for label, env in shown.items():
            names = list(env.get_wrapper_attr("volumes"))
            for number in range(n_episodes):
                volume, title = names[number % len(names)], f"seed {seed + number}"
                episode = video.capture(
                    prepared.agent, env, volume_name=volume, seed=EVALUATION_SEED + seed + number, title=title
                )
                print(f"{label}: {volume}, {title}: {outcome(episode)}", flush=True)
