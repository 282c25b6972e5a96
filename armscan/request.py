"""What `armscan.evaluate` and `armscan.watch` are asked for: their words, read before anything is loaded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from armscan.checks import check_int, check_seed
from armscan.errors import InvalidValueError, listed
from armscan.settings import CHANGES, PHANTOM
from armscan.words import read_words

COMMON = ("run", "data", "phantoms", "episodes", "seed", "out", "tracking", *CHANGES)
TEXTS = ("run", "data", "start", "clustering", "device", "out", "tracking", "tracking_experiment")
# Words of armscan.run that these commands have others for.
SAID_OTHERWISE = {
    "tracking.uri": "tracking=URI",
    "tracking.experiment": "tracking_experiment=NAME",
    "evaluation.episodes": "episodes=NUMBER",
}
N_PHANTOMS = 8


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What a command can be asked for.

    Args:
        what: it makes, as a message has it.
        n_episodes: where nothing is said.
        more: keys that the other does not have.
    """

    what: str
    n_episodes: int
    more: tuple[str, ...] = ()

    @property
    def own(self) -> tuple[str, ...]:
        """Its keys; whatever else stands beside an agent without a run is of that agent's configuration."""
        return (*COMMON, *self.more)

    @property
    def said_otherwise(self) -> dict[str, str]:
        """Words of armscan.run, and those that say it here."""
        return {key: here for key, here in SAID_OTHERWISE.items() if here.partition("=")[0] in self.own}


EVALUATION = Asked(what="an evaluation", n_episodes=200, more=("tracking_experiment",))
FILM = Asked(what="a film", n_episodes=3)


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is to be evaluated or filmed, and how.

    Args:
        run: the id of a tracked run, None for an agent without one.
        agent_words: what the configuration of an agent without a run is composed of.
        data: a folder, `phantom`, or None for the volumes of the agent's own configuration.
        n_phantoms: how many.
        n_episodes: for each split.
        seed: of the episodes.
        changes: rules that are changed.
        out: where it is left, None for the usual place.
        tracking: of the store, None for the usual one.
        tracking_experiment: likewise, of MLflow.
    """

    run: str | None = None
    agent_words: tuple[str, ...] = ()
    data: str | None = None
    n_phantoms: int = N_PHANTOMS
    n_episodes: int
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


def parse(words: Sequence[str], asked: Asked) -> Request:
    """Returns what `key=value` words ask for.

    Args:
        words: of the command line.
        asked: what the command can be asked for.

    Raises:
        InvalidValueError: if a word is something else, a key unknown, or a value of another kind.
    """
    keys = [word.partition("=")[0] for word in words]
    with_agent = "agent" in keys
    _check_keys(keys, asked)
    # Beside an agent without a run, whatever is not this command's own is of the configuration.
    others = [word for word, key in zip(words, keys, strict=True) if with_agent and key not in asked.own]
    values = read_words([word for word in words if word not in others], ("run", "agent", *asked.own[1:]), TEXTS)
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
        n_episodes=check_int("episodes", values.get("episodes", asked.n_episodes), at_least=1),
        seed=check_seed("seed", values.get("seed", 0)),
        changes={name: values[name] for name in CHANGES if name in values},
        out=Path(values["out"]) if "out" in values else None,
        tracking=values.get("tracking"),
        tracking_experiment=values.get("tracking_experiment"),
    )


def _check_keys(keys: Sequence[str], asked: Asked) -> None:
    """Raises `InvalidValueError` for words of armscan.run that would be ignored here, or be said in two ways."""
    names = [key.lstrip("+~") for key in keys]
    for name in names:
        if name in SAID_OTHERWISE or name.startswith(("tracking.", "evaluation.")):
            here = asked.said_otherwise.get(name, listed(asked.said_otherwise.values()))
            raise InvalidValueError(f"{name} is of armscan.run, and not read by {asked.what}: give {here}")
    for name, key in {**CHANGES, "data": "data.path"}.items():
        if name in names and key in names:
            raise InvalidValueError(f"{name} and {key} are both given, but they are one value: give one of them")
    if "experiment" in names and "agent" not in names:
        raise InvalidValueError("experiment is a preset, for agent=NAME: a run has its own configuration")
