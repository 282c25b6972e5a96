"""A trial that trains agents: one after another, with each of its seeds."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import optuna
from omegaconf import DictConfig
from optuna.exceptions import UpdateFinishedTrialError

from armscan.agents import Learner
from armscan.config.defaults import to_plain
from armscan.errors import CheckpointError, InvalidValueError, TrackingError, TrackingUnavailableError
from armscan.experiment.build import (
    RunSetup,
    build_setup,
    check_each_seen,
    check_episodes,
    check_keys,
    on_plane_of,
    set_up,
)
from armscan.experiment.job import Invocation
from armscan.experiment.provenance import place_tags, start_tracking, volume_tags
from armscan.experiment.results import RunResult
from armscan.experiment.runner import keep_results, train_agent
from armscan.sweeps.scheduling.limits import LimitReachedError
from armscan.sweeps.scheduling.state import TEST_PREFIX
from armscan.sweeps.tasks.attempt import TAKEN_OVER, Attempt, over_seeds, seed_folder, volumes_of
from armscan.sweeps.tasks.generation import begin_generation
from armscan.sweeps.tasks.reporter import TRAINING_METRICS, Reporter
from armscan.tracking import TrackedRun, TrackingStore, draw_learning_curve, open_store, run_of_study, take_over
from armscan.tracking.tags import PARENT_TAG, SELECTION_PREFIX, STUDY_TAG, VALIDATION_PREFIX
from armscan.training import (
    TEST,
    VALIDATION,
    EpochReport,
    Evaluation,
    TrainingResult,
    evaluate,
    record_episode,
    resume_from_checkpoint,
)
from armscan.training.episode_seeds import SELECTION_SEED, VIDEO_SEED
from armscan.utils.files import atomic_write
from armscan.utils.log import log
from armscan.utils.retry import RETRY_S
from armscan.utils.run_files import LAST_CHECKPOINT, LEARNING_CURVE_FILE, RUN_FILE, VIDEO_FILE, folder_lock

if TYPE_CHECKING:
    from mlflow.entities import Run

Conclude = Callable[[RunSetup, TrainingResult, TrackedRun, Path], dict[str, float]]


class TrainingTask:
    """The task of training an agent, with each of a trial's seeds."""

    def metrics(self, config: DictConfig) -> tuple[str, ...]:
        """Return the names of the metrics of the best validation and of the training."""
        return (*Evaluation((), on_plane_of(config)).metrics(), *TRAINING_METRICS)

    @property
    def final_metric(self) -> str:
        """Name of the mean steps of an episode on the test volumes."""
        return f"{TEST_PREFIX}mean_steps"

    def check(self, config: DictConfig) -> None:
        """See `Task.check`."""
        check_keys(config)
        experiment = build_setup(config, volumes_of(config))
        if not isinstance(experiment.agent, Learner):
            raise InvalidValueError(
                f"agent is {config.agent.get('_target_')!r}, but the trials of this study need one that learns"
            )
        check_episodes(experiment)
        # The race compares candidates in as many episodes.
        check_each_seen("evaluation.episodes", experiment.n_episodes, "validation", experiment.split)

    def run(self, attempt: Attempt) -> dict[str, float]:
        """Train with each seed; return the interquartile means of the metrics over the seeds. See `Task.run`.

        For `solved`, a share of the seeds, return the mean.
        """
        for seed in attempt.seeds:
            # In a population, the next generation begins from this folder, and not from that of an earlier attempt.
            is_elsewhere = attempt.interval is not None and not (seed_folder(attempt.folder, seed) / RUN_FILE).exists()
            if seed not in attempt.seeds_done or is_elsewhere:
                attempt.keep_seed(seed, _train(attempt, seed))
            else:
                _adopt(attempt, seed)
        of_seeds = [attempt.seeds_done[seed] for seed in attempt.seeds]
        return {name: over_seeds(name, [metrics[name] for metrics in of_seeds]) for name in of_seeds[0]}

    def validate(self, attempt: Attempt) -> dict[str, float]:
        """Train, and return the metrics of validation episodes that had no part in choosing the weights."""
        (seed,) = attempt.seeds
        return _train(attempt, seed, partial(_evaluate_on_validation, attempt))

    def evaluate(self, attempt: Attempt) -> dict[str, float]:
        """Train, evaluate, record a video and save the policy; return the metrics on the test volumes."""
        (seed,) = attempt.seeds
        return _train(attempt, seed, partial(_evaluate_on_test, attempt))


def _evaluate_on_validation(
    attempt: Attempt, setup: RunSetup, result: TrainingResult, tracked: TrackedRun, folder: Path
) -> dict[str, float]:
    """Evaluate a trained agent on the validation volumes; return its metrics there."""
    seed, n_episodes = SELECTION_SEED + setup.seed, setup.n_episodes
    played = evaluate(setup.agent, setup.validation_env, n_episodes=n_episodes, seed=seed, on_plane=setup.on_plane)
    attempt.keep_episodes({VALIDATION: played})
    metrics = played.metrics()
    tracked.log_metrics(
        {f"{SELECTION_PREFIX}{name}": value for name, value in metrics.items()}, n_env_steps=result.best.n_env_steps
    )
    return metrics


def _evaluate_on_test(
    attempt: Attempt, setup: RunSetup, result: TrainingResult, tracked: TrackedRun, folder: Path
) -> dict[str, float]:
    """Evaluate a trained agent and the baselines, and store the results; return the metrics on the test volumes."""
    reached = RunResult.of(setup, result)
    keep_results(tracked, result, reached, folder)
    tested = reached.evaluations[TEST]
    attempt.keep_episodes({TEST: tested, **reached.baselines})
    agent, seed = setup.agent, VIDEO_SEED + setup.seed
    record_episode(agent, setup.video_env, folder / VIDEO_FILE, seed=seed)
    assert isinstance(agent, Learner)
    # Deferred: most trials export no policy.
    from armscan.policies.build import save_policy

    save_policy(agent, setup.test_env, tracked, folder, log, slice_px=setup.smallest_slice_px)
    metrics = {f"{TEST_PREFIX}{name}": value for name, value in tested.metrics().items()}
    for volume, evaluation in tested.by_volume().items():
        metrics |= {f"{TEST_PREFIX}volume/{volume}/{name}": value for name, value in evaluation.metrics().items()}
    return metrics


def _train(attempt: Attempt, seed: int, conclude: Conclude | None = None) -> dict[str, float]:
    """Train with one seed, from the last checkpoint if there is one; return metrics, including those of `conclude`."""
    config, choices = attempt.config(seed)
    setup = set_up(config)
    folder = seed_folder(attempt.folder, seed)
    folder.mkdir(parents=True, exist_ok=True)
    reporter = Reporter(attempt, seed, setup.budget)
    pruned, concluded = None, {}
    with folder_lock(folder):
        setup, tracked, earlier = _start_or_resume(attempt, setup, config, choices, folder)
        attempt.opened(tracked)
        with tracked:
            if earlier is None:
                earlier = begin_generation(attempt, setup, folder, run_id=tracked.run_id)
            try:
                result = train_agent(
                    setup,
                    folder,
                    [tracked, reporter],
                    run_id=tracked.run_id,
                    tell=log,
                    earlier=earlier,
                    until_env_steps=attempt.interval[1] if attempt.interval else None,
                )
            except optuna.TrialPruned as error:
                pruned = error
                tracked.set_pruned()
            except LimitReachedError:
                tracked.end_requeued()
                raise
            except UpdateFinishedTrialError:
                tracked.end("FAILED", reason=TAKEN_OVER)
                raise
            else:
                concluded = conclude(setup, result, tracked, folder) if conclude else {}
            draw_learning_curve(reporter.reports, folder / LEARNING_CURVE_FILE, title=tracked.name)
            attempt.show_picture(folder / LEARNING_CURVE_FILE)
            tracked.log_results(folder)
            tracked.log_files(folder / RUN_FILE)
        attempt.opened(None)
    if pruned is not None:
        raise pruned
    return reporter.metrics(result) | concluded


def _adopt(attempt: Attempt, seed: int) -> None:
    """Move a finished training of an earlier attempt to this one: its files, and its run below that of the trial."""
    folder = seed_folder(attempt.folder, seed)
    if (folder / RUN_FILE).exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    with folder_lock(folder):
        config, _ = attempt.config(seed)
        if found := _begun(folder, attempt, config):
            store, run = found
            for tag, value in _tags_of(attempt, folder).items():
                store.set_tag(run.info.run_id, tag, value)


def _tags_of(attempt: Attempt, folder: Path) -> dict[str, str]:
    """Return the tags of a training that say where it belongs."""
    return {**place_tags(folder), **attempt.tags, PARENT_TAG: attempt.run_id}


def _start_or_resume(
    attempt: Attempt, setup: RunSetup, config: DictConfig, choices: dict[str, str], folder: Path
) -> tuple[RunSetup, TrackedRun, list[EpochReport] | None]:
    """Open the tracked run of a training, and restore the agent as an earlier attempt left it.

    Returns:
        The setup of the run, the tracked run, and the reports of the epochs so far; None if none has ended.
    """
    agent = setup.agent
    assert isinstance(agent, Learner)
    if found := _begun(folder, attempt, config):
        store, run = found
        tags = volume_tags(setup) | _tags_of(attempt, folder)
        reopen = partial(TrackedRun.reopen, store, run, folder=folder, config=to_plain(config), tags=tags)
        if (folder / LAST_CHECKPOINT).exists():
            try:
                earlier = resume_from_checkpoint(agent, folder, setup.provenance(run.info.run_id))
            except CheckpointError:
                # The trial can always start again, with an untrained agent.
                setup = set_up(config)
            else:
                return setup, reopen(), earlier
        elif not any(name.startswith(VALIDATION_PREFIX) for name in run.data.metrics):
            # It was interrupted before the end of its first epoch.
            return setup, reopen(), None
    invocation = Invocation(folder, attempt.overrides, attempt.command, choices)
    tracked = start_tracking(config, invocation, setup, parent_id=attempt.run_id, tags=attempt.tags, retry_s=RETRY_S)
    atomic_write(folder / RUN_FILE, json.dumps({"run_id": tracked.run_id}))
    return setup, tracked, None


def _begun(folder: Path, attempt: Attempt, config: DictConfig) -> tuple[TrackingStore, Run] | None:
    """Return the tracked run of a training, with its store, after taking it over from an earlier attempt."""
    if found := _begun_in(folder, attempt, config):
        return found
    for before in attempt.folders_before:
        if found := _begun_in(before / folder.name, attempt, config):
            _take_over(found[1].info.run_id, before / folder.name, folder)
            return found
    return None


def _begun_in(folder: Path, attempt: Attempt, config: DictConfig) -> tuple[TrackingStore, Run] | None:
    """Return the tracked run that this study has begun in a folder, with its store; None if there is none.

    A study of the same name may have left its files there: one in another storage, or one that was deleted.
    """
    if not (file := folder / RUN_FILE).exists():
        return None
    store, experiment_id = open_store(**to_plain(config.tracking), retry_s=RETRY_S)
    known = partial(run_of_study, store, experiment_id=experiment_id, where=str(file))
    tags = {STUDY_TAG: attempt.tags[STUDY_TAG], "seed": str(config.seed)}
    try:
        run = known(json.loads(file.read_text())["run_id"], tags=tags)
        # An earlier attempt had another trial number and another run of the trial, but below the same run of the study.
        study_run_id = store.get_run(attempt.run_id).data.tags[PARENT_TAG]
        known(run.data.tags.get(PARENT_TAG, ""), tags={PARENT_TAG: study_run_id})
    except TrackingUnavailableError:
        raise
    except TrackingError as error:
        log(f"trial {attempt.trial.number} does not resume from {folder}: {error}")
        return None
    return store, run


def _take_over(run_id: str, before: Path, folder: Path) -> None:
    """Copy the files of the earlier attempt."""
    for file in before.iterdir():
        if file.is_file() and not file.name.startswith(".") and file.name != RUN_FILE:
            shutil.copyfile(file, folder / file.name)
    take_over(run_id, before, folder)
    # Last: from then on this folder takes precedence.
    shutil.copyfile(before / RUN_FILE, folder / RUN_FILE)
