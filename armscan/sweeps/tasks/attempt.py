"""An attempt at a trial: its configuration, reports, MLflow run and folder."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from optuna.trial import Trial

from armscan.stats.bootstrap import interquartile_mean, mean
from armscan.sweeps.scheduling.claim import PendingWrites
from armscan.sweeps.scheduling.state import retried_by
from armscan.sweeps.storage.attribute_names import (
    ENV_STEPS,
    EPISODES,
    INTERVAL,
    PARENT,
    PRUNED_AT,
    RETRY_OF,
    RUN,
    SEEDS,
    SUBJECTS,
)
from armscan.sweeps.storage.reports import reports_of, store_report
from armscan.sweeps.tasks.folders import trial_folder
from armscan.tracking import TrackedRun
from armscan.training import Evaluation, Split
from armscan.utils.files import sha256

N_SUM_CHARS = 12
# Why a run has ended whose worker was taken for dead.
TAKEN_OVER = "taken over by another worker"


@dataclass
class Attempt:
    """One attempt at a trial.

    Args:
        trial: Trial as it is in the storage.
        overrides: Overrides that distinguish its configuration from that of other trials.
        composed: Configuration, whose seed `config` replaces, and the choice of each group.
        command: Command that resumes the study.
        seeds: Training seeds, used one after another.
        study_folder: Folder of the study.
        run_id: MLflow run ID of the trial.
        tags: Tags of the tracked runs of its trainings, which name their study and trial.
        objectives: Names of the metrics that it reports to the pruner while it runs; none without pruning.
        report_progress: Function to call with the progress of the trial.
        opened: Function to call with the tracked run of a training at its start, and with None at its end.
        show_picture: Function to call with an image file for the dashboard.
        writes: Pending writes about the trial.
        transaction: Function that runs a transaction; see `Storage.transaction`.
    """

    trial: Trial
    overrides: list[str]
    composed: tuple[DictConfig, dict[str, str]]
    command: str
    seeds: tuple[int, ...]
    study_folder: Path
    run_id: str
    tags: Mapping[str, str]
    objectives: tuple[str, ...]
    report_progress: Callable[[dict[str, Any]], None]
    opened: Callable[[TrackedRun | None], None]
    show_picture: Callable[[Path], None]
    writes: PendingWrites
    transaction: Callable[[Callable[[], bool]], bool]
    env_steps: int = field(init=False)
    _of_seeds: dict[str, Mapping[str, float]] = field(init=False)
    # Steps that have been reported, including those before the trial was requeued or retried.
    _reported: set[int] = field(init=False)
    # Step at which it was pruned, if its worker ended before it told so.
    _pruned_at: int | None = field(init=False)

    def __post_init__(self) -> None:
        attributes = self.trial.user_attrs
        self._of_seeds, self._pruned_at = dict(attributes.get(SEEDS, {})), attributes.get(PRUNED_AT)
        self.env_steps = sum(int(one.get(ENV_STEPS, 0)) for one in self._of_seeds.values())
        is_resumed = attributes.keys() & {RUN, RETRY_OF}
        self._reported = set(reports_of(self.trial.storage.get_trial(self.trial._trial_id))) if is_resumed else set()

    @property
    def folder(self) -> Path:
        """Folder of its files."""
        return trial_folder(self.study_folder, self.trial.number)

    @property
    def folders_before(self) -> list[Path]:
        """Folders of the attempts that it replaces, the latest first."""
        trials = self.trial.study.get_trials(deepcopy=False)
        return [trial_folder(self.study_folder, number) for number in retried_by(self.trial, trials)]

    @property
    def parent_folder(self) -> Path | None:
        """Folder of the trial whose checkpoints it begins from; None if it begins untrained."""
        number = self.trial.user_attrs.get(PARENT)
        return None if number is None else trial_folder(self.study_folder, number)

    @property
    def interval(self) -> tuple[int, int] | None:
        """Environment steps at which its part of a training begins and ends; None if it trains the whole."""
        interval = self.trial.user_attrs.get(INTERVAL)
        return None if interval is None else (int(interval[0]), int(interval[1]))

    def config(self, seed: int) -> tuple[DictConfig, dict[str, str]]:
        """Return the configuration of one of its trainings, and the choice of each group."""
        config, choices = self.composed
        # Much faster than composing it again.
        seeded = config.copy()
        seeded.seed = seed
        return seeded, choices

    @property
    def seeds_done(self) -> dict[int, Mapping[str, float]]:
        """The metrics of the completed seeds, including those of an earlier attempt."""
        return {int(seed): metrics for seed, metrics in self._of_seeds.items()}

    def keep_seed(self, seed: int, metrics: Mapping[str, float]) -> None:
        """Store the metrics of a completed seed."""
        self._of_seeds = self._of_seeds | {str(seed): dict(metrics)}
        self.writes.append(partial(self.trial.set_user_attr, SEEDS, self._of_seeds))
        if any(each not in self.seeds_done for each in self.seeds):
            # At once: the next report may take long, and a retry must not train this seed again.
            self.writes.flush_with(self.transaction, lambda: True)

    def keep_episodes(self, evaluations: Mapping[str, Evaluation]) -> None:
        """Store the episodes of the final evaluation, by the name of their volumes or baseline."""
        plain = {name: {"on_plane": each.on_plane, "episodes": each.columns()} for name, each in evaluations.items()}
        self._keep(EPISODES, plain)

    def keep_subjects(self, subjects: Mapping[str, str]) -> None:
        """Store the subject of each test volume, by its name, for a task without episodes."""
        self._keep(SUBJECTS, dict(subjects))

    def _keep(self, name: str, value: dict[str, Any]) -> None:
        # Not a user attribute, which the dashboard would show in full.
        storage, trial_id = self.trial.storage, self.trial._trial_id
        self.writes.append(partial(storage.set_trial_system_attr, trial_id, name, value))

    def report(
        self,
        metrics: Mapping[str, float],
        *,
        seed: int,
        n_env_steps: int,
        report_every_env_steps: int,
        total_env_steps: int,
        n_inherited_env_steps: int = 0,
    ) -> None:
        """Report the progress of a training.

        Args:
            metrics: Metrics so far: the objectives, and `mean_return` for display, if known. A trial that does not
                report every objective is not pruned.
            seed: Seed of the training.
            n_env_steps: Environment steps so far.
            report_every_env_steps: Environment steps between two reports; trials are compared at multiples of it.
            total_env_steps: Environment steps of a whole training.
            n_inherited_env_steps: Environment steps that its parent has taken. Default: 0.

        Raises:
            optuna.TrialPruned: If the trial is pruned.
        """
        done = [one for each, one in self.seeds_done.items() if each in self.seeds and each != seed]
        self.env_steps = sum(int(one[ENV_STEPS]) for one in done) + n_env_steps - n_inherited_env_steps
        progress = {"seed": seed, ENV_STEPS: self.env_steps}
        self.report_progress(progress | ({"return": metrics["mean_return"]} if "mean_return" in metrics else {}))
        if not self.objectives or any(name not in metrics for name in self.objectives):
            return
        step = self.seeds.index(seed) * total_env_steps
        step += n_env_steps // report_every_env_steps * report_every_env_steps
        if step in self._reported:
            if step == self._pruned_at:
                raise optuna.TrialPruned
            return
        self._reported.add(step)
        values = [over_seeds(name, [one[name] for one in (*done, metrics)]) for name in self.objectives]
        if self.writes.flush_with(self.transaction, partial(self._is_to_be_pruned, step, values)):
            raise optuna.TrialPruned

    def _is_to_be_pruned(self, step: int, values: Sequence[float]) -> bool:
        study, storage, trial_id = self.trial.study, self.trial.storage, self.trial._trial_id
        # Not by the trial's own methods: they never repeat a report, although the storage may have lost it with the
        # connection, and they refuse several objectives.
        store_report(storage, trial_id, step, values)
        trial = storage.get_trial(trial_id)
        # A pruner decides once: asked again, because only the reply was lost, Optuna's halving would let it continue.
        if trial.user_attrs.get(PRUNED_AT) == step:
            return True
        if is_pruned := study.pruner.prune(study, trial):
            storage.set_trial_user_attr(trial_id, PRUNED_AT, step)
        return is_pruned


def over_seeds(metric: str, values: Sequence[float]) -> float:
    """Return a metric of a trial: the interquartile mean over its seeds; the mean of `solved`, a share of the seeds."""
    return float((mean if metric == "solved" else interquartile_mean)(np.array(values)))


def config_sha256(config: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a configuration's values except the seed, by which the runs of one trial differ."""
    return _sha256({key: value for key, value in config.items() if key != "seed"})


def _sha256(values: Mapping[str, Any]) -> str:
    return sha256(json.dumps(values, sort_keys=True, default=str).encode())


def volumes_of(config: DictConfig) -> Split:
    """Return the volumes of a configuration, which stay in memory until those of another one are requested."""
    return _volumes(OmegaConf.to_yaml(config.data, resolve=True))


def volume_sums(split: Split) -> dict[str, str]:
    """Return how many volumes each part has, with a checksum of their names and contents, to compare them later."""
    prints = split.fingerprints()
    return {part: f"{len(each)} with the checksum {_sha256(each)[:N_SUM_CHARS]}" for part, each in prints.items()}


@lru_cache(maxsize=1)
def _volumes(data: str) -> Split:
    volumes: Split = instantiate(OmegaConf.create(data), _convert_="object")
    return volumes
