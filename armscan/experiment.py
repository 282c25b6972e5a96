"""One run from beginning to end: built, tracked, trained, evaluated, and shown.

No part of the configuration goes further than this module, `stage.py` and `building.py`.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from armscan.agents import Learner
from armscan.building import check_keys
from armscan.console import print_results, print_where_to_look, progress_reporter
from armscan.files import CURVE_FILE, FILM_FILE, LAST_CHECKPOINT, check_free, held
from armscan.invocation import Invocation
from armscan.policies.making import keep_policy
from armscan.provenance import start_tracking
from armscan.settings import evaluate_command, resume_command
from armscan.stage import Stage
from armscan.tracking import TrackedRun
from armscan.training import (
    TEST,
    TRAINING,
    Budget,
    Callback,
    EpochReport,
    Evaluation,
    TrainingResult,
    evaluate,
    film_episode,
    train,
)

# First seeds of the episodes that are played for each purpose, so that none is played for two.
VALIDATION_SEED, TRAINING_VOLUMES_SEED, TEST_VOLUMES_SEED, FILM_SEED = 10**6, 2 * 10**6, 3 * 10**6, 4 * 10**6


def run_experiment(config: DictConfig, invocation: Invocation) -> dict[str, dict[str, float]]:
    """Trains an agent, if it is one that learns, evaluates and tracks it.

    Args:
        config: the composed configuration.
        invocation: how it was asked for.

    Returns:
        The figures of the final evaluations, by the name of their volumes.
    """
    check_keys(config)
    job = invocation.job
    with held(invocation.folder):
        check_free(invocation.folder)
        stage = Stage.built(config)
        tracked = start_tracking(config, invocation, stage)
        return carry_out(stage, tracked, invocation.folder, config.tracking.uri, job_label=job.label if job else None)


def carry_out(
    stage: Stage,
    tracked: TrackedRun,
    folder: Path,
    tracking_uri: str,
    *,
    job_label: str | None = None,
    earlier: Sequence[EpochReport] = (),
) -> dict[str, dict[str, float]]:
    """Trains, evaluates and shows, in a run that is tracked.

    Args:
        stage: what is run.
        tracked: its run.
        folder: where it leaves its files.
        tracking_uri: of the store.
        job_label: what stands before the lines of one job of several, None for a single run.
        earlier: the epochs before, where a training goes on.

    Returns:
        The figures of the final evaluations, by the name of their volumes.
    """
    tell = partial(print, *([f"[{job_label}]"] if job_label else []), flush=True)
    tell(f"run {tracked.run_id}: {tracked.name}")
    with _told_how_to_resume(tracked.run_id, tracking_uri, folder, is_told=job_label is None), tracked:
        result = None
        if isinstance(stage.experiment.agent, Learner):
            _tell_of_longer_epochs(stage.experiment.agent, stage.experiment.budget, tell)
            callbacks = [progress_reporter(job_label), tracked]
            result = learned(stage, folder, callbacks, run_id=tracked.run_id, earlier=earlier)
        tell(f"playing {stage.experiment.n_episodes} episodes on the training volumes, and as many on the test volumes")
        evaluations = judged(stage)
        film_episode(stage.experiment.agent, stage.film_env, folder / FILM_FILE, seed=FILM_SEED + stage.experiment.seed)
        tracked.keep_results(result, evaluations, folder)
        if isinstance(stage.experiment.agent, Learner):
            keep_policy(stage.experiment.agent, stage.test_env, tracked, folder, tell)
    if job_label is None:
        _show(result, evaluations, folder, tracking_uri)
        print(f"judge it  {evaluate_command(tracked.run_id, tracking_uri)}")
    return {name: evaluation.metrics() for name, evaluation in evaluations.items()}


def learned(
    stage: Stage, folder: Path, callbacks: Sequence[Callback], *, run_id: str, earlier: Sequence[EpochReport] = ()
) -> TrainingResult:
    """Trains the agent of a stage, which is one that learns, and returns the course of it; see `train`."""
    agent, budget = stage.experiment.agent, stage.experiment.budget
    assert isinstance(agent, Learner)
    seed = VALIDATION_SEED + stage.experiment.seed
    validate = partial(evaluate, agent, stage.validation_env, n_episodes=budget.validation_episodes, seed=seed)
    return train(agent, budget, validate, folder, callbacks, origin=stage.origin(run_id), earlier=earlier)


def _tell_of_longer_epochs(learner: Learner, budget: Budget, tell: Callable[[str], None]) -> None:
    """Says so where an epoch is longer than the configuration has it, because the agent takes more steps at once."""
    if (n := learner.env_steps_at_once) > budget.epoch_env_steps:
        tell(
            f"validating every {n} environment steps, which the agent takes at once "
            f"(training.epoch_env_steps = {budget.epoch_env_steps} is less)"
        )


def judged(stage: Stage) -> dict[str, Evaluation]:
    """Returns the final evaluations of a stage's agent, on the training and on the test volumes, by their names."""
    agent, n_episodes, seed = stage.experiment.agent, stage.experiment.n_episodes, stage.experiment.seed
    return {
        TRAINING: evaluate(agent, stage.training_env, n_episodes=n_episodes, seed=TRAINING_VOLUMES_SEED + seed),
        TEST: evaluate(agent, stage.test_env, n_episodes=n_episodes, seed=TEST_VOLUMES_SEED + seed),
    }


def _show(result: TrainingResult | None, evaluations: dict[str, Evaluation], folder: Path, tracking_uri: str) -> None:
    how = f"deterministic policy, as it was after {result.best.n_env_steps} steps" if result else "nothing to learn"
    print_results(f"results ({how})", evaluations)
    print_where_to_look(folder, tracking_uri, files=(CURVE_FILE, FILM_FILE) if result else (FILM_FILE,))


@contextlib.contextmanager
def _told_how_to_resume(run_id: str, tracking_uri: str, folder: Path, *, is_told: bool) -> Iterator[None]:
    """Says how to go on with what ends before its end, where there is something to go on from."""
    try:
        yield
    except BaseException:
        if is_told and (folder / LAST_CHECKPOINT).exists():
            print(f"resume with: {resume_command(run_id, tracking_uri)}", file=sys.stderr)
        raise
