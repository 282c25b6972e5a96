"""Videos of episodes: animated GIFs, and MP4s beside them."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from types import TracebackType
from typing import Self, cast

import numpy as np
from numpy.typing import NDArray
from PIL import GifImagePlugin, Image, ImageChops, ImageDraw

from armscan.agents.protocols import Agent
from armscan.envs.panels import TEXT_COLOUR, font
from armscan.training.episode_results import Env, EpisodeResult
from armscan.training.episodes import play
from armscan.utils.text import counted

FRAME_MS = 600
LAST_FRAME_MS = 2400
MAX_COLOURS = 128
MAX_ATTEMPTS = 20
# Duration of each picture of an MP4; a picture of an episode is repeated as often as needed.
PICTURE_MS = 100
QUALITY = 8
# A browser can play the file before it is fully loaded.
PLAYS_AT_ONCE = ("-movflags", "+faststart")
TITLE_AT = (16, 3)

Picture = NDArray[np.uint8]


class VideoRecorder:
    """Writes pictures one by one, so that they are never all in memory.

    Args:
        gif: GIF file to write.
        mp4: MP4 file to write with the same pictures. Default: None, no MP4.
    """

    def __init__(self, gif: Path, mp4: Path | None = None) -> None:
        self._gif = gif.open("wb")
        self._mp4_file = mp4
        self._mp4: Generator[None, Picture | None, None] | None = None
        self._before: Image.Image | None = None

    def add(self, picture: Picture, duration_ms: int = FRAME_MS) -> None:
        """Add a picture, shape (height, width, 3), both even, and the same for all pictures."""
        self._add_to_gif(Image.fromarray(picture), duration_ms)
        if self._mp4_file is not None:
            if self._mp4 is None:
                self._mp4 = _mp4_writer(self._mp4_file, picture)
            for _ in range(duration_ms // PICTURE_MS):
                self._mp4.send(picture)

    def capture(self, agent: Agent, env: Env, *, volume_name: str, seed: int, title: str = "") -> EpisodeResult:
        """Play an episode and record it; the last frame is held longer.

        Args:
            agent: Agent to play the episode.
            env: Environment made with `render_mode="rgb_array"`.
            volume_name: Name of one of the environment's volumes.
            seed: Seed of the episode.
            title: Text above each picture; above the last one, the outcome follows it. Default: no text.

        Returns:
            The episode, as an evaluation would have played it.
        """
        latest: list[Picture] = []

        def look() -> None:
            if latest:
                self.add(_titled(latest.pop(), title))
            latest.append(cast(Picture, env.render()))

        episode = play(agent, env, volume_name, seed, look)
        self.add(_titled(latest.pop(), title and f"{title}: {outcome(episode)}"), LAST_FRAME_MS)
        return episode

    def _add_to_gif(self, picture: Image.Image, duration_ms: int) -> None:
        box = (0, 0, *picture.size)
        if self._before is not None:
            # Only the changed part; an unchanged picture is still added, because it has its own duration.
            box = ImageChops.difference(self._before, picture).getbbox() or (0, 0, 1, 1)
        changed = picture.crop(box).quantize(MAX_COLOURS, dither=Image.Dither.NONE)
        if self._before is None:
            whole = changed.copy()
            self._gif.writelines(GifImagePlugin.getheader(whole, info={"loop": 0})[0])
        self._gif.writelines(
            GifImagePlugin.getdata(changed, box[:2], duration=duration_ms, disposal=1, include_color_table=True)
        )
        self._before = picture

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._gif:
            self._gif.write(b";")
        if self._mp4 is not None:
            self._mp4.close()


def _mp4_writer(file: Path, picture: Picture) -> Generator[None, Picture | None, None]:
    # Deferred: a training needs none.
    import imageio_ffmpeg

    # H.264 with colours at half the resolution, which every browser plays; it brings its own ffmpeg.
    writer: Generator[None, Picture | None, None] = imageio_ffmpeg.write_frames(
        str(file),
        picture.shape[1::-1],
        fps=1000 / PICTURE_MS,
        codec="libx264",
        pix_fmt_out="yuv420p",
        quality=QUALITY,
        macro_block_size=2,
        output_params=list(PLAYS_AT_ONCE),
    )
    writer.send(None)
    return writer


def outcome(episode: EpisodeResult) -> str:
    """Return the outcome of an episode as a string."""
    how = "success" if episode.is_success else "no success"
    off = f"{episode.distance_mm:.1f} mm and {episode.distance_deg:.1f}°"
    return f"{how} after {counted(episode.n_steps, 'step')}, {off} from the labelled plane"


def record_episode(agent: Agent, env: Env, path: Path, *, seed: int) -> None:
    """Play an episode on the first volume and write it as an animated GIF; the last frame is held longer.

    Args:
        agent: Agent to play the episode.
        env: Environment made with `render_mode="rgb_array"`.
        path: File to write, ending in `.gif`.
        seed: Seed of the episode; if it starts solved, the next few seeds are tried.
    """
    first = next(iter(env.get_wrapper_attr("volumes")))
    for attempt in range(MAX_ATTEMPTS):
        _, info = env.reset(seed=seed + attempt, options={"volume": first})
        if not info["starts_solved"]:
            break
    # If this is a link, its target must not be overwritten.
    path.unlink(missing_ok=True)
    with VideoRecorder(path) as video:
        video.capture(agent, env, volume_name=first, seed=seed + attempt)


def _titled(picture: Picture, title: str) -> Picture:
    if not title:
        return picture
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text(TITLE_AT, title, fill=TEXT_COLOUR, font=font(13))
    return np.asarray(image)
