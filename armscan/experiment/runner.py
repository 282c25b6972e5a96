"""One run from beginning to end: build, track, train, evaluate, show."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from armscan.agents import Learner
from armscan.config.command_hints import armscan_command, resume_command
from armscan.experiment.build import RunSetup, check_episodes, check_keys, set_up
from armscan.experiment.console import print_result_table, print_where_to_look
from armscan.experiment.effects import check_effects, unused_network
from armscan.experiment.job import Invocation
from armscan.experiment.provenance import start_tracking
from armscan.experiment.results import RunResult
from armscan.tracking import TrackedRun, draw_learning_curve
from armscan.tracking.tags import BEST_ENV_STEP
from armscan.tracking.view import artifact_address
from armscan.training import (
    VALIDATION,
    Budget,
    Callback,
    EpochReport,
    TrainingResult,
    evaluate,
    record_episode,
    train,
)
from armscan.training.episode_seeds import VALIDATION_SEED, VIDEO_SEED
from armscan.training.progress import progress_reporter
from armscan.utils.compilation import log_compilation
from armscan.utils.console import print_sentence
from armscan.utils.files import named_if_full, sha256
from armscan.utils.processes import no_garbage_collection
from armscan.utils.run_files import (
    LAST_CHECKPOINT,
    LEARNING_CURVE_FILE,
    RESULT_SHA256_TAGS,
    RESULTS_PAGE,
    VIDEO_FILE,
    check_free,
    folder_lock,
)
from armscan.utils.text import counted

OF_ENVIRONMENT = ("armscan.volumes", "armscan.anatomy", "armscan.envs")
COMPILING = "compiling the environment for this machine, which takes up to a minute; later runs find it in the cache"


def run_experiment(config: DictConfig, invocation: Invocation) -> dict[str, dict[str, float]]:
    """Train (if it is a `Learner`), evaluate and track an agent.

    Returns:
        The metrics, by the names of the agent's volumes and of the baselines.
    """
    check_keys(config)
    check_effects(config, invocation.overrides)
    job = invocation.job
    told = log_compilation(COMPILING, lambda dispatcher: dispatcher.py_func.__module__.startswith(OF_ENVIRONMENT))
    with folder_lock(invocation.folder):
        check_free(invocation.folder)
        with no_garbage_collection():
            with told:
                setup = set_up(config)
            check_episodes(setup)
            if unused := unused_network(config, setup.training_env.observation_space, invocation.overrides):
                print_sentence(f"note: {unused!r} has no effect: network=auto chooses by the observation")
            tracked = start_tracking(config, invocation, setup, parent_id=job.grid.run_id if job else None)
        return run_tracked(setup, tracked, invocation.folder, config.tracking.uri, job_label=job.label if job else None)


def run_tracked(
    setup: RunSetup,
    tracked: TrackedRun,
    folder: Path,
    tracking_uri: str,
    *,
    job_label: str | None = None,
    earlier: Sequence[EpochReport] = (),
) -> dict[str, dict[str, float]]:
    """Train, evaluate and print results in a tracked run.

    Args:
        setup: Setup of the run.
        tracked: Run that tracks it.
        folder: Folder of the run's files.
        tracking_uri: MLflow tracking URI.
        job_label: Prefix of the printed lines of a grid's job. Default: None, a single run.
        earlier: Epochs before the interruption of a resumed training. Default: none.

    Returns:
        The metrics, by the names of the agent's volumes and of the baselines.
    """
    before = f"[{job_label}] " if job_label else ""

    def tell(text: str) -> None:
        print_sentence(f"{before}{text}")

    tell(f"run {tracked.run_id}: {tracked.name}")
    if names := setup.split.description:
        tell(names)
    for note in setup.split.palm_notes:
        tell(f"note: {note}")
    trust = setup.needs_trust
    again = resume_command(tracked.run_id, tracking_uri, trust=trust)
    hint = _resume_hint_on_error(tracked, again, folder, is_told=job_label is None)
    with hint, tracked, named_if_full(folder):
        how = getattr(setup.agent, "validation_note", None)
        result = None
        if isinstance(setup.agent, Learner):
            _tell_validation_interval(setup.agent, setup.budget, tell)
            n_episodes = counted(setup.budget.validation_episodes, "episode")
            measured = ", ".join(filter(None, ["validation", n_episodes, how]))
            callbacks = [progress_reporter(job_label, measured), tracked]
            result = train_agent(setup, folder, callbacks, run_id=tracked.run_id, tell=tell, earlier=earlier)
            if result.is_solved:
                n_taken = result.reports[-1].n_env_steps
                tell(f"solved: stopped at {n_taken:,} of {setup.budget.env_steps:,} steps")
        tell(f"playing {counted(setup.n_episodes, 'episode')} on the training volumes, and as many on the test volumes")
        reached = RunResult.of(setup, result)
        if job_label is None:
            policy = f"{how} policy" if how else "policy"
            origin = f"{policy}, as it was after {result.best.n_env_steps} steps" if result else "nothing to learn"
            print_result_table(f"results ({origin})", reached.table(), reached.notes())
        tell("writing the results, the video of an episode, and the policy")
        record_episode(setup.agent, setup.video_env, folder / VIDEO_FILE, seed=VIDEO_SEED + setup.seed)
        keep_results(tracked, result, reached, folder)
        if result:
            draw_learning_curve(result.reports, folder / LEARNING_CURVE_FILE, title=tracked.name)
        tracked.log_results(folder)
        if isinstance(setup.agent, Learner):
            with no_garbage_collection():
                # Deferred: exporting a policy loads more than training does, and comes last.
                from armscan.policies.build import save_policy

                save_policy(setup.agent, setup.test_env, tracked, folder, tell, slice_px=setup.smallest_slice_px)
    if job_label is None:
        files = (RESULTS_PAGE, *((LEARNING_CURVE_FILE,) if result else ()), VIDEO_FILE)
        print_where_to_look(folder, tracking_uri, files=files)
        arguments = ("evaluate", tracked.run_id, "--data", "FOLDER")
        print(f"evaluate  {armscan_command(*arguments, tracking=tracking_uri, trust=trust)}")
    return reached.metrics()


def _tell_validation_interval(learner: Learner, budget: Budget, tell: Callable[[str], None]) -> None:
    """Tell if validations are farther apart than the configuration says."""
    at_once, every = learner.env_steps_at_once, budget.eval_every_env_steps
    if at_once > every:
        tell(
            f"validating every {at_once} environment steps, which the agent takes at once "
            f"(training.eval_every_env_steps = {every} is less)"
        )


def train_agent(
    setup: RunSetup,
    folder: Path,
    callbacks: Sequence[Callback],
    *,
    run_id: str,
    tell: Callable[[str], None],
    earlier: Sequence[EpochReport] = (),
    until_env_steps: int | None = None,
) -> TrainingResult:
    """Train the agent of a setup, and tell how its updates are computed; see `train`.

    Args:
        setup: Setup of the run, whose agent is a `Learner`.
        folder: Folder of its checkpoints.
        callbacks: Callbacks of the training.
        run_id: MLflow run ID, kept in the checkpoints.
        tell: Receives lines for the user.
        earlier: Epochs of a training that is resumed. Default: none.
        until_env_steps: Environment steps at which to stop, before the budget is spent. Default: None, the whole
            budget.
    """
    agent, budget = setup.agent, setup.budget
    assert isinstance(agent, Learner)
    if note := agent.update_note:
        tell(f"update: {note}")
    if not earlier and (note := getattr(agent, "warm_up_note", None)):
        tell(f"random steps: {note}")
    seed = VALIDATION_SEED + setup.seed
    validate = partial(
        evaluate,
        agent,
        setup.validation_env,
        n_episodes=budget.validation_episodes,
        seed=seed,
        on_plane=setup.on_plane,
    )
    result = train(
        agent,
        budget,
        validate,
        folder,
        callbacks,
        provenance=setup.provenance(run_id),
        earlier=earlier,
        until_env_steps=until_env_steps,
    )
    has_ended = not result.is_solved and agent.n_env_steps >= budget.env_steps
    if has_ended and (note := getattr(agent, "schedule_note", None)):
        tell(f"training.schedule: {note}")
    return result


def keep_results(tracked: TrackedRun, result: TrainingResult | None, reached: RunResult, folder: Path) -> None:
    """Log the final figures, write the results into the run's folder, and tag the run with their checksums.

    Args:
        tracked: Run to log to.
        result: Result of the training. Figures are logged at its best epoch, whose weights they evaluate. None if there
            was nothing to learn.
        reached: Final evaluations, and the baselines.
        folder: Folder of the run.
    """
    _log_result(tracked, result, reached)
    reached.write(folder, title=tracked.name)
    files = {tag: folder / name for name, tag in RESULT_SHA256_TAGS.items()}
    tracked.set_tags({tag: sha256(file.read_bytes()) for tag, file in files.items() if file.exists()})


def _log_result(tracked: TrackedRun, result: TrainingResult | None, reached: RunResult) -> None:
    """Log the final figures, the best checkpoint as a model, and the table as description."""
    for name, metrics in reached.metrics().items():
        figures = {f"{name.replace(' ', '_')}/{figure}": value for figure, value in metrics.items()}
        # Training has already logged the validations.
        if name != VALIDATION:
            tracked.log_metrics(figures, n_env_steps=result.best.n_env_steps if result else 0)
    if result:
        tracked.log_metrics({BEST_ENV_STEP: result.best.n_env_steps}, n_env_steps=result.reports[-1].n_env_steps)
        tracked.log_model(reached.model_metrics(), n_env_steps=result.best.n_env_steps)
    curve = f"\n\n![learning curve]({artifact_address(tracked.run_id, LEARNING_CURVE_FILE)})" if result else ""
    tracked.set_description(reached.markdown() + curve)


@contextlib.contextmanager
def _resume_hint_on_error(tracked: TrackedRun, command: str, folder: Path, *, is_told: bool) -> Iterator[None]:
    """Print the command that resumes the run, if an error ends it and it has a checkpoint; or uploads its end."""
    try:
        yield
    except BaseException:
        if is_told and tracked.is_finished:
            print(f"upload the rest with: {armscan_command('runs', 'sync', str(folder))}", file=sys.stderr)
        elif is_told and (folder / LAST_CHECKPOINT).exists():
            print(f"resume with: {command}", file=sys.stderr)
        raise
