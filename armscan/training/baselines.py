"""Baselines for an agent: random planes, and a sweep from the middle outward, on the same volumes and rules.

Their episodes are cached on the machine, because many runs have the same volumes and rules.
"""

from __future__ import annotations

import contextlib
import json
from dataclasses import asdict
from functools import cache
from pathlib import Path

import armscan
from armscan.agents.baselines import ROTATIONS, Exhaustive, ExhaustiveAgent, RandomAgent
from armscan.agents.protocols import Agent
from armscan.envs.actions import COMPONENTS
from armscan.envs.rules import Rules
from armscan.stats.on_plane import ON_PLANE, OnPlane
from armscan.training.episode_results import Env, Evaluation
from armscan.training.episodes import evaluate
from armscan.utils.files import atomic_write, cache_folder, sha256

FOLDER = "baselines"
# Code that determines how the episodes of the baselines go.
SOURCES = (
    *("agents/baselines.py", "agents/batch_agent.py", "training/episodes.py"),
    *("volumes/**/*.py", "anatomy/**/*.py", "envs/**/*.py"),
)
AGENT, RANDOM = "agent", "random"


def evaluate_baselines(
    env: Env, *, n_episodes: int, seed: int, on_plane: tuple[OnPlane, ...] = ON_PLANE
) -> dict[str, Evaluation]:
    """Return the episodes of the baselines, by their names: `random` and, if one component is free, a sweep.

    Args:
        env: Environment of the volumes.
        n_episodes: Number of episodes, in turn on the volumes.
        seed: Seed of the evaluation, which the seeds of its episodes follow from.
        on_plane: Limits within which a plane counts as the labelled one. Default: those of `Evaluation`.
    """
    rules = env.get_wrapper_attr("rules")
    names = tuple(rules.action_names)
    agents: dict[str, Agent] = {RANDOM: RandomAgent(len(names))}
    free = [name for name in names if name in COMPONENTS]
    if len(free) == 1:
        steps = Exhaustive()
        step = f"{steps.step_deg:g} deg" if free[0] in ROTATIONS else f"{steps.step_mm:g} mm"
        agents[f"sweep {step}"] = ExhaustiveAgent(
            names, free, step_mm=steps.step_mm, step_deg=steps.step_deg, n_steps=rules.n_steps
        )
    known = _rules_of(rules)
    evaluations = {}
    for name, agent in agents.items():
        file = _file(name, known, n_episodes, seed) if known else None
        evaluation = _cached(file) if file else None
        if evaluation is None:
            evaluation = evaluate(agent, env, n_episodes=n_episodes, seed=seed)
            if file:
                _cache(evaluation, file)
        evaluations[name] = Evaluation(evaluation.episodes, on_plane)
    return evaluations


def _rules_of(rules: Rules) -> str | None:
    """Return all that episodes depend on besides the agent; None if it includes classes that are not armscan's."""
    parts = (rules.reward, *rules.tissues, *([rules.transform] if rules.transform else []))
    if not all(type(part).__module__.startswith("armscan.") for part in parts):
        return None
    prints = [(name, volume.subject, volume.fingerprint) for name, volume in rules.volumes.items()]
    shared = (rules.action_names, rules.success_threshold, rules.ends, rules.max_steps, rules.start, rules.bounds)
    return repr((prints, shared, rules.tissues, rules.transform, type(rules.reward), vars(rules.reward), _sources()))


@cache
def _sources() -> str:
    """Return the checksum of the code that plays episodes, so that changed code does not reuse old ones."""
    folder = Path(armscan.__file__).parent
    files = sorted(file for pattern in SOURCES for file in folder.glob(pattern))
    return sha256(b"".join(file.read_bytes() for file in files))


def _file(name: str, rules: str, n_episodes: int, seed: int) -> Path:
    digest = sha256(repr((name, rules, n_episodes, seed)).encode())
    return cache_folder() / FOLDER / f"{digest[:32]}.json"


def _cached(file: Path) -> Evaluation | None:
    try:
        return Evaluation.of_plain(json.loads(file.read_bytes()))
    except (OSError, ValueError):
        # Missing or damaged: the episodes are played again.
        return None


def _cache(evaluation: Evaluation, file: Path) -> None:
    text = json.dumps([asdict(episode) for episode in evaluation.episodes])
    # A cache that cannot be written only costs time.
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(file, text)
