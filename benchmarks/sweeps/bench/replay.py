"""A study on simulated trainings, as armscan runs it: search, pruning, then a race of the best over fresh seeds."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import optuna
from hydra.utils import instantiate
from omegaconf import DictConfig
from optuna.trial import Trial, TrialState

from armscan.config.compose import compose
from armscan.stats.bootstrap import interquartile_mean
from armscan.sweeps.scheduling.race import race
from armscan.sweeps.space.parameter import Value
from armscan.utils.arrays import FloatArray
from benchmarks.sweeps.bench.surrogate import SELECTION_PART, SimulatedConfig, Surrogate

# Limits a study: a sampler that keeps proposing points that are pruned must not run for ever.
MAX_TRIALS_A_TRAINING = 5


@dataclass(frozen=True)
class Rule:
    """Sampler, pruner and budget of a simulated study.

    Args:
        sampler: Name of a group `study/sampler`, such as `tpe`.
        pruner: Name of a group `study/pruner`, such as `median`.
        n_seeds: Trainings of each trial. Default: 1.
        has_presets: Whether the first trials try the presets of the sweep (`study.enqueue`). Default: False.
    """

    sampler: str
    pruner: str
    n_seeds: int = 1
    has_presets: bool = False

    @property
    def further(self) -> str:
        """Suffix of its name after sampler and pruner, such as `, 2 seeds`; empty for the default."""
        return (f", {self.n_seeds} seeds" if self.n_seeds > 1 else "") + (", presets" if self.has_presets else "")


# The rule of a study of armscan by default.
DEFAULT = Rule("tpe", "median")


@dataclass(frozen=True)
class Candidate:
    """A trial that ran to its end.

    Args:
        value: Interquartile mean over its seeds of the mean steps in the selection.
        config: Its configuration.
        number: Number of the trial in its search, from 0.
        n_trainings: Environment steps of the search until the end of this trial, in whole trainings.
        values: Values of its configuration by name.
    """

    value: float
    config: SimulatedConfig
    number: int
    n_trainings: float
    values: dict[str, Value]


@dataclass(frozen=True)
class Search:
    """A search that has ended.

    Args:
        candidates: The trials that ran to their end, the best first.
        n_trials: Number of all trials.
        n_trainings: Environment steps of all trials, in whole trainings.
    """

    candidates: tuple[Candidate, ...]
    n_trials: int
    n_trainings: float


def search(
    surrogate: Surrogate,
    sweep: str,
    rule: Rule,
    *,
    n_trainings: int,
    seed: int,
    enqueued: Sequence[Mapping[str, Value]] = (),
) -> Search:
    """Search until the environment steps of so many whole trainings are spent.

    Args:
        surrogate: Simulates the trainings.
        sweep: Name of the sweep that sets the options of sampler and pruner.
        rule: How to search.
        n_trainings: The budget; the last trial may exceed it.
        seed: Seed of the sampler, and of the trainings.
        enqueued: Values by name that the first trials try; the sampler proposes what is missing. Default: none.
    """
    settings = _settings(sweep, rule.sampler, rule.pruner)
    study = optuna.create_study(
        sampler=instantiate(settings.sampler, seed=seed), pruner=instantiate(settings.pruner), direction="minimize"
    )
    for values in enqueued:
        study.enqueue_trial(dict(values))
    total, spent = surrogate.env_steps[-1], 0.0
    rng, candidates, n_trials = np.random.default_rng(seed), [], 0
    while spent < n_trainings * total and n_trials < MAX_TRIALS_A_TRAINING * n_trainings:
        trial, n_trials = study.ask(), n_trials + 1
        values = surrogate.space.suggest(trial)
        config = surrogate.config(values)
        value, n_env_steps = _run(trial, config, rule.n_seeds, rng)
        spent += n_env_steps
        if value is None:
            study.tell(trial, state=TrialState.PRUNED)
        else:
            study.tell(trial, value)
            candidates.append(Candidate(value, config, trial.number, float(spent / total), values))
    # Of equal values, the first stays first, as in armscan.
    candidates.sort(key=lambda each: each.value)
    return Search(tuple(candidates), n_trials, float(spent / total))


def _run(trial: Trial, config: SimulatedConfig, n_seeds: int, rng: np.random.Generator) -> tuple[float | None, float]:
    """Return the value of a trial, None if it was pruned, and its environment steps; see `Attempt.report`."""
    env_steps = config.surrogate.env_steps
    total, values = env_steps[-1], []
    for seed in range(n_seeds):
        training = config.train(rng)
        for n_env_steps, steps in zip(env_steps, training.curve, strict=True):
            trial.report(float(np.mean([*values, steps])), int(seed * total + n_env_steps))
            if trial.should_prune():
                return None, seed * total + n_env_steps
        values.append(training.selection)
    return float(interquartile_mean(np.array(values))), n_seeds * total


class Choice(NamedTuple):
    """Choice of a final evaluation.

    Args:
        place: Place of the chosen candidate.
        n_trainings: Number of trainings of all candidates.
    """

    place: int
    n_trainings: int


def choose(scores: FloatArray, *, min_seeds: int, mean_seeds: int) -> Choice:
    """Let candidates race over fresh seeds; if `mean_seeds` equals `min_seeds`, all get the same number.

    Args:
        scores: Scores of all possible trainings, shape (candidates, seeds), greater is better; no candidate gets more
            seeds than these.
        min_seeds: Seeds of all candidates.
        mean_seeds: Seeds of a candidate on average, at most.
    """
    known: dict[int, dict[int, float]] = {place: {} for place in range(len(scores))}
    seeds = range(scores.shape[1])
    while not (stands := race(known, seeds, min_seeds=min_seeds, mean_seeds=mean_seeds)).is_over:
        for place, seed in stands.missing:
            known[place][seed] = float(scores[place, seed])
    assert stands.chosen is not None
    return Choice(stands.chosen, sum(map(len, known.values())))


def scores_of(
    candidates: Sequence[SimulatedConfig], n_seeds: int, rng: np.random.Generator, part: int = SELECTION_PART
) -> FloatArray:
    """Return scores of fresh trainings, the negative steps of the selection, shape (candidates, seeds)."""
    return -np.array([each.draw(rng, n_seeds)[:, part] for each in candidates])


def silence() -> None:
    """Silence Optuna's log, and all warnings, in this process."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.simplefilter("ignore")


@lru_cache
def _settings(sweep: str, sampler: str, pruner: str) -> DictConfig | Any:
    return compose([f"sweep={sweep}", f"study/sampler={sampler}", f"study/pruner={pruner}"]).study
