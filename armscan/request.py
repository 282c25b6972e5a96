"""What `python -m armscan.evaluate` is asked for: its words, read and checked before anything is loaded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from armscan.checks import check_int, check_seed
from armscan.errors import InvalidValueError, listed
from armscan.settings import CHANGES, PHANTOM
from armscan.words import read_words

OWN = ("run", "data", "phantoms", "episodes", "seed", "out", "tracking", "tracking_experiment", *CHANGES)
TEXTS = ("run", "data", "start", "clustering", "device", "out", "tracking", "tracking_experiment")
# Words of armscan.run that an evaluation has others for.
SAID_OTHERWISE = {
    "tracking.uri": "tracking=URI",
    "tracking.experiment": "tracking_experiment=NAME",
    "evaluation.episodes": "episodes=NUMBER",
}
N_PHANTOMS, N_EPISODES = 8, 200


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is to be evaluated, and how.

    Args:
        run: the id of a tracked run, None for an agent without one.
        agent_words: what the configuration of an agent without a run is composed of.
        data: a folder, `phantom`, or None for the volumes of the agent's own configuration.
        n_phantoms: how many.
        n_episodes: for each split.
        seed: of the episodes.
        changes: rules that are changed.
        out: the JSON file, None for one of its own in `evaluations`.
        tracking: of the store, None for the usual one.
        tracking_experiment: likewise, of MLflow.
    """

    run: str | None = None
    agent_words: tuple[str, ...] = ()
    data: str | None = None
    n_phantoms: int = N_PHANTOMS
    n_episodes: int = N_EPISODES
    seed: int = 0
    changes: Mapping[str, Any] = field(default_factory=dict)
    out: Path | None = None
    tracking: str | None = None
    tracking_experiment: str | None = None

    @property
    def folder(self) -> str | None:
        """The folder of volumes, None for phantoms or the agent's own volumes."""
        return None if self.data == PHANTOM else self.data

    @property
    def config_words(self) -> list[str]:
        """What the configuration of an agent without a run is composed of, the kind of its data included."""
        return [*self.agent_words, *(["data=nifti"] if self.agent_words and self.folder else [])]


def parse(words: Sequence[str]) -> Request:
    """Returns what `key=value` words ask for.

    Raises:
        InvalidValueError: if a word is something else, a key unknown, or a value of another kind.
    """
    keys = [word.partition("=")[0] for word in words]
    with_agent = "agent" in keys
    _check_keys(keys)
    # Beside an agent without a run, whatever is not this command's own is of the configuration.
    others = [word for word, key in zip(words, keys, strict=True) if with_agent and key not in OWN]
    values = read_words([word for word in words if word not in others], ("run", "agent", *OWN[1:]), TEXTS)
    if with_agent and "run" in values:
        raise InvalidValueError("run and agent are both given, but a run has its agent: give one of them")
    if not with_agent and "run" not in values:
        raise InvalidValueError("run is not set, but it must be: give run=ID, or agent=NAME (--help explains)")
    if "phantoms" in values and values.get("data") != PHANTOM:
        raise InvalidValueError(f"phantoms is {values['phantoms']!r}, but it is for data={PHANTOM}")
    if "tracking_experiment" in values and not with_agent:
        raise InvalidValueError(
            "tracking_experiment is for agent=NAME: the evaluation of a run is tracked in the run's own experiment"
        )
    return Request(
        run=values.get("run"),
        agent_words=tuple(others),
        data=values.get("data"),
        n_phantoms=check_int("phantoms", values.get("phantoms", N_PHANTOMS), at_least=1, at_most=10_000),
        n_episodes=check_int("episodes", values.get("episodes", N_EPISODES), at_least=1),
        seed=check_seed("seed", values.get("seed", 0)),
        changes={name: values[name] for name in CHANGES if name in values},
        out=Path(values["out"]) if "out" in values else None,
        tracking=values.get("tracking"),
        tracking_experiment=values.get("tracking_experiment"),
    )


def _check_keys(keys: Sequence[str]) -> None:
    """Raises `InvalidValueError` for words of armscan.run that would be ignored here, or be said in two ways."""
    names = [key.lstrip("+~") for key in keys]
    for name in names:
        if name in SAID_OTHERWISE or name.startswith(("tracking.", "evaluation.")):
            here = SAID_OTHERWISE.get(name, listed(SAID_OTHERWISE.values()))
            raise InvalidValueError(f"{name} is of armscan.run, and not read by an evaluation: give {here}")
    for name, key in {**CHANGES, "data": "data.path"}.items():
        if name in names and key in names:
            raise InvalidValueError(f"{name} and {key} are both given, but they are one value: give one of them")
    if "experiment" in names and "agent" not in names:
        raise InvalidValueError("experiment is a preset, for agent=NAME: a run has its own configuration")
