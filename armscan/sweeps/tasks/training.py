"""A trial that trains agents: one after another, with each of its seeds."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import optuna
from omegaconf import DictConfig, OmegaConf
from optuna.exceptions import UpdateFinishedTrialError

from armscan.agents import Learner
from armscan.envs.rules import ON_BUDGET
from armscan.errors import InvalidValueError
from armscan.experiment.build import (
    RunSetup,
    build_setup,
    check_each_seen,
    check_episodes,
    check_keys,
    on_plane_of,
    set_up,
)
from armscan.experiment.results import RunResult
from armscan.experiment.runner import keep_results, train_agent
from armscan.sweeps.scheduling.limits import LimitReachedError
from armscan.sweeps.scheduling.state import TEST_PREFIX
from armscan.sweeps.tasks.attempt import TAKEN_OVER, Attempt, over_seeds, volumes_of
from armscan.sweeps.tasks.folders import seed_folder
from armscan.sweeps.tasks.generation import begin_generation, best_of_generation, inherited
from armscan.sweeps.tasks.reporter import TRAINING_METRICS, Reporter
from armscan.sweeps.tasks.resume import adopt, start_or_resume
from armscan.tracking import TrackedRun, draw_learning_curve
from armscan.tracking.tags import SELECTION_PREFIX
from armscan.training import (
    TEST,
    Evaluation,
    TrainingResult,
    evaluate,
    record_episode,
)
from armscan.training.episode_seeds import SELECTION_SEED, VIDEO_SEED
from armscan.utils.log import log
from armscan.utils.run_files import LEARNING_CURVE_FILE, RUN_FILE, VIDEO_FILE, folder_lock

Conclude = Callable[[RunSetup, TrainingResult, TrackedRun, Path], dict[str, float]]


class TrainingTask:
    """The task of training an agent, with each of a trial's seeds."""

    def metrics(self, config: DictConfig) -> tuple[str, ...]:
        """Return the names of the metrics on the validation volumes and of the training.

        Where every episode has as many steps, the number of steps is none of them: all trials would be equal.
        """
        names = (*Evaluation((), on_plane_of(config)).metrics(), *TRAINING_METRICS)
        is_fixed = OmegaConf.select(config, "env.ends") == ON_BUDGET
        return tuple(name for name in names if not (is_fixed and name.startswith("mean_steps")))

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
        # The value of a trial is from as many episodes on the validation volumes.
        check_each_seen("evaluation.episodes", experiment.n_episodes, "validation", experiment.split)

    def run(self, attempt: Attempt) -> dict[str, float]:
        """Train with each seed; return the interquartile means of the metrics over the seeds. See `Task.run`.

        The metrics are of validation episodes that had no part in choosing the weights. In a population, they are of
        the best validation of the generation. For `solved`, a share of the seeds, return the mean.
        """
        conclude = _evaluate_on_validation if attempt.interval is None else partial(_best_validation, attempt)
        for seed in attempt.seeds:
            # In a population, the next generation begins from this folder, and not from that of an earlier attempt.
            is_elsewhere = attempt.interval is not None and not (seed_folder(attempt.folder, seed) / RUN_FILE).exists()
            if seed not in attempt.seeds_done or is_elsewhere:
                attempt.keep_seed(seed, _train(attempt, seed, conclude))
            else:
                adopt(attempt, seed)
        of_seeds = [attempt.seeds_done[seed] for seed in attempt.seeds]
        return {name: over_seeds(name, [metrics[name] for metrics in of_seeds]) for name in of_seeds[0]}

    def validate(self, attempt: Attempt) -> dict[str, float]:
        """Train, and return the same metrics as `run`, of more episodes. See `Task.validate`."""
        return self.run(attempt)

    def evaluate(self, attempt: Attempt) -> dict[str, float]:
        """Train, evaluate, record a video and save the policy; return the metrics on the test volumes."""
        (seed,) = attempt.seeds
        return _train(attempt, seed, partial(_evaluate_on_test, attempt))


def _best_validation(
    attempt: Attempt, setup: RunSetup, result: TrainingResult, tracked: TrackedRun, folder: Path
) -> dict[str, float]:
    """Return the metrics of the best validation of a generation."""
    before = inherited(attempt, result.reports)
    return best_of_generation(result.reports, before, setup.budget.best_by).evaluation.metrics()


def _evaluate_on_validation(
    setup: RunSetup, result: TrainingResult, tracked: TrackedRun, folder: Path
) -> dict[str, float]:
    """Evaluate a trained agent on the validation volumes; return its metrics there."""
    seed, n_episodes = SELECTION_SEED + setup.seed, setup.n_episodes
    played = evaluate(setup.agent, setup.validation_env, n_episodes=n_episodes, seed=seed, on_plane=setup.on_plane)
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


def _train(attempt: Attempt, seed: int, conclude: Conclude) -> dict[str, float]:
    """Train with one seed, from the last checkpoint if there is one; return the metrics of it and of `conclude`."""
    config, choices = attempt.config(seed)
    setup = set_up(config)
    folder = seed_folder(attempt.folder, seed)
    folder.mkdir(parents=True, exist_ok=True)
    reporter = Reporter(attempt, seed, setup.budget)
    pruned, metrics = None, {}
    with folder_lock(folder):
        setup, tracked, earlier = start_or_resume(attempt, setup, config, choices, folder)
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
                metrics = conclude(setup, result, tracked, folder) | reporter.metrics(result)
            draw_learning_curve(reporter.reports, folder / LEARNING_CURVE_FILE, title=tracked.name)
            attempt.show_picture(folder / LEARNING_CURVE_FILE)
            tracked.log_results(folder)
            tracked.log_files(folder / RUN_FILE)
        attempt.opened(None)
    if pruned is not None:
        raise pruned
    return metrics
