"""A film of one episode."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from armscan.agents.protocols import Agent
from armscan.training.evaluation import Env

FRAME_MS = 600
LAST_FRAME_MS = 2400
MAX_COLOURS = 128
MAX_ATTEMPTS = 20


def film_episode(agent: Agent, env: Env, path: Path, *, seed: int) -> None:
    """Plays an episode on the first volume and writes it as an animated GIF, its last frame held longer.

    Args:
        agent: plays it.
        env: made with `render_mode="rgb_array"`.
        path: the file, ending in `.gif`.
        seed: of the episode; where it starts solved, that of the next one is tried, a few times.
    """
    for attempt in range(MAX_ATTEMPTS):
        observation, info = env.reset(
            seed=seed + attempt, options={"volume": next(iter(env.get_wrapper_attr("volumes")))}
        )
        if not info["starts_solved"]:
            break
    frames = [_picture(env)]
    agent.begin(seed=seed, bounds=env.get_wrapper_attr("scene").bounds)
    reward, ended = info["reward"], False
    while not ended:
        observation, reward, terminated, truncated, _ = env.step(agent.act(observation, float(reward)))
        frames.append(_picture(env))
        ended = terminated or truncated
    durations = [FRAME_MS] * (len(frames) - 1) + [LAST_FRAME_MS]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0)


def _picture(env: Env) -> Image.Image:
    picture = Image.fromarray(env.render())  # type: ignore[arg-type]
    return picture.quantize(MAX_COLOURS, dither=Image.Dither.NONE)
