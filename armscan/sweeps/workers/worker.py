"""A worker of a study: it claims a trial, runs it, tells its outcome, and claims the next, until the study ends."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import optuna
from optuna.exceptions import UpdateFinishedTrialError
from optuna.samplers import BaseSampler
from optuna.trial import Trial, TrialState

from armscan.config.command_hints import kept_command
from armscan.config.compose import compose_run
from armscan.config.defaults import MULTIRUN, to_plain
from armscan.config.error_messages import one_line_message
from armscan.errors import FolderInUseError, StorageUnavailableError, TrackingUnavailableError
from armscan.sweeps.scheduling.claim import ClaimStatus, TrialOutcome
from armscan.sweeps.scheduling.limits import LimitReachedError
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.storage.attribute_names import CONFIG_SHA256, ENV_STEPS, FAILURE, FOLDER, METRICS, RUN
from armscan.sweeps.study.components import make, read_settings
from armscan.sweeps.study.dashboard import note_run, show_picture, shown_metrics, table_of_seeds
from armscan.sweeps.study.open import open_for_work
from armscan.sweeps.study.phase import Phase
from armscan.sweeps.tasks.attempt import TAKEN_OVER, Attempt, config_sha256
from armscan.sweeps.tasks.folders import trial_folder
from armscan.sweeps.tasks.task import check_metrics
from armscan.sweeps.workers.heartbeat import Heartbeat
from armscan.sweeps.workers.trial_run import close_requeued, end_run, open_run
from armscan.tracking import TrackedRun
from armscan.utils.log import log, silence_libraries

WAIT_S = 1.0
MAX_REASON_CHARS = 2000


class Worker:
    """Runs trials of one phase of a study, one after another, each with the command's overrides and its own values.

    Args:
        phase: The phase.
        overrides: Overrides that its trials are composed from.
        heartbeat: Heartbeat of the worker in this phase.
        other: Scheduler of another phase, whose trials can be run while this one waits. Default: None, there is none.
    """

    def __init__(
        self, phase: Phase, overrides: Sequence[str], heartbeat: Heartbeat, other: TrialScheduler | None = None
    ) -> None:
        self._phase, self._overrides, self._heartbeat, self._other = phase, overrides, heartbeat, other
        self._tracked: TrackedRun | None = None

    def work(self) -> str | None:
        """Run trials until none is left and those of other workers have ended, or until only the other phase has some.

        Returns:
            Why the phase has ended; None if it has not.
        """
        self._phase.scheduler.read_stop_request()
        outcome: TrialOutcome | None = None
        conclude: Callable[[], None] | None = None
        while True:
            # Before claiming: it may take seconds, in which others claim trials.
            self._phase.scheduler.check_termination()
            # One operation tells the previous trial and claims the next: with many workers, operations add up.
            trial = self._heartbeat.claim(outcome, conclude)
            self._heartbeat.clean_up()
            outcome, conclude = None, None
            if trial is not None:
                outcome = self._run(trial)
                conclude = partial(self._conclude, outcome, self._tracked) if outcome else None
                self._tracked = None
            else:
                status = self._wait_for_trial()
                if not status.can_claim:
                    return status.end_reason

    def _wait_for_trial(self) -> ClaimStatus:
        """Wait until a trial of this phase can be claimed, or none ever will be, or only the other phase has some."""
        scheduler = self._phase.scheduler
        while True:
            scheduler.read_stop_request()
            state = scheduler.state()
            scheduler.check_termination(state)
            status = scheduler.claim_status(state)
            # A running trial may yet have to be retried.
            if status.can_claim or (status.end_reason is not None and not state.running):
                return status
            other = self._other
            if status.end_reason is None and other is not None and other.claim_status(other.state()).can_claim:
                return status
            time.sleep(WAIT_S)

    def _run(self, trial: Trial) -> TrialOutcome | None:
        """Run a trial; return its outcome, None if it was requeued or taken over."""
        log(f"{self._phase.name}: trial {trial.number} {'is resumed' if RUN in trial.user_attrs else 'begins'}")
        writes = self._heartbeat.writes
        try:
            metrics = check_metrics(self._run_task(trial), self._phase.objectives)
        except optuna.TrialPruned:
            return TrialOutcome(trial, TrialState.PRUNED, writes)
        except UpdateFinishedTrialError:
            # This worker was taken for dead: the trial is another's.
            self._let_go(trial, self._tracked)
            self._heartbeat.cleanup = None
        except LimitReachedError as limit:
            log(f"trial {trial.number} is requeued: {limit}")
            self._heartbeat.requeue()
        except FolderInUseError as error:
            # Another process still uploads what an earlier attempt has left.
            log(f"trial {trial.number}: {error}")
            self._heartbeat.requeue()
            time.sleep(WAIT_S)
        except TrackingUnavailableError:
            self._heartbeat.requeue()
            raise
        except StorageUnavailableError:
            raise
        # Any other error fails the trial, not the study; a request to leave does not arrive as an exception.
        except (Exception, SystemExit, KeyboardInterrupt) as error:
            line = one_line_message(error)
            if line is None:
                traceback.print_exc()
            reason = (line or repr(error))[:MAX_REASON_CHARS]
            return TrialOutcome(trial, TrialState.FAIL, writes, attributes={FAILURE: reason})
        else:
            values = [metrics[name] for name in self._phase.objectives]
            n_seeds = len(self._phase.seeds_of(trial))
            attributes = {METRICS: metrics, **shown_metrics(metrics, n_seeds)}
            return TrialOutcome(trial, TrialState.COMPLETE, writes, values, attributes)
        return None

    def _run_task(self, trial: Trial) -> dict[str, float]:
        phase, writes = self._phase, self._heartbeat.writes
        # By the trial's number: parallel workers draw different points, and a single worker is reproducible.
        seed = np.random.SeedSequence((phase.seed, trial.number)).generate_state(1)[0]
        trial.study.sampler = make("sampler", phase.sampler, BaseSampler, seed=int(seed))
        # A new object each time: writes that the trial has cached may have been lost with the connection.
        chosen = phase.scheduler.storage.transaction(lambda: phase.suggest(Trial(trial.study, trial._trial_id)))
        own = [*overrides_of(chosen), *phase.overrides]
        config, choices = compose_run([*self._overrides, *own])
        folder = trial_folder(phase.folder, trial.number)
        folder.mkdir(parents=True, exist_ok=True)
        config_sum = config_sha256(to_plain(config))
        with self._heartbeat.opening:
            self._tracked = open_run(phase, trial, chosen, config_sum, writes)
            self._opened(None)
        for name, value in ((FOLDER, str(folder)), (CONFIG_SHA256, config_sum)):
            if trial.user_attrs.get(name) != value:
                writes.append(partial(trial.set_user_attr, name, value))
        attempt = Attempt(
            trial=trial,
            overrides=own,
            composed=(config, choices),
            command=kept_command([MULTIRUN[0], *self._overrides]),
            seeds=phase.seeds_of(trial),
            study_folder=phase.folder,
            run_id=self._tracked.run_id,
            tags=phase.tags_of(trial),
            objectives=phase.reported,
            report_progress=self._heartbeat.report_progress,
            opened=self._opened,
            show_picture=lambda picture: writes.append(partial(show_picture, trial, picture, phase.artifacts)),
            writes=writes,
            transaction=phase.scheduler.storage.transaction,
        )
        try:
            return phase.run(attempt)
        finally:
            # A resumed trial may be requeued again before it gets as far as before.
            n_env_steps = max(attempt.env_steps, int(trial.user_attrs.get(ENV_STEPS, 0)))
            writes.append(partial(trial.set_user_attr, ENV_STEPS, n_env_steps))
            if attempt.seeds_done:
                where = phase.store, phase.experiment_id, self._tracked.run_id, folder
                writes.append(partial(note_run, trial, *where, table_of_seeds(attempt.seeds_done)))

    def _opened(self, training: TrackedRun | None) -> None:
        self._heartbeat.cleanup = partial(close_requeued, training, self._tracked)

    def _conclude(self, outcome: TrialOutcome, tracked: TrackedRun | None) -> None:
        """Log and track the outcome of a trial, once the storage has it."""
        trial, state = outcome.trial, outcome.state
        if not outcome.is_told:
            self._let_go(trial, tracked)
            return
        metrics = outcome.attributes.get(METRICS, {})
        shown = ", ".join(f"{name} {metrics[name]:.4g}" for name in self._phase.objectives if name in metrics)
        reason = outcome.attributes.get(FAILURE)
        log(f"trial {trial.number} " + (f"failed: {reason}" if reason else f"{state.name.lower()} {shown}".rstrip()))
        if not reason:
            # Not earlier: until the storage has its outcome, the trial may have to be resumed.
            self._phase.remove_checkpoints(trial)
        if tracked is not None:
            end_run(self._phase, tracked, trial, state, metrics, reason)

    def _let_go(self, trial: Trial, tracked: TrackedRun | None) -> None:
        log(f"trial {trial.number} was taken over by another worker")
        if tracked is not None:
            tracked.end("FAILED", reason=TAKEN_OVER)


def work(overrides: Sequence[str], make_heartbeat: Callable[..., Heartbeat]) -> None:
    """Work on a study until it is over.

    Args:
        overrides: Overrides that its trials are composed from.
        make_heartbeat: Function that makes the heartbeat of this worker in a phase.

    Raises:
        ServiceUnavailableError: If the storage or the tracking store is unavailable for longer than a worker waits.
    """
    silence_libraries()
    opened = open_for_work(*read_settings(overrides), overrides, is_worker=True)

    def run_phase(phase: Phase, other: Phase | None) -> str | None:
        heartbeat = make_heartbeat(phase.scheduler, on_death=phase.close_runs_of)
        with heartbeat.running():
            return Worker(phase, overrides, heartbeat, None if other is None else other.scheduler).work()

    for phase in opened.phases:
        # While the selection waits for other workers, this one trains the control for the test.
        other = opened.finals[1] if opened.finals and phase is opened.finals[0] else None
        while (reason := run_phase(phase, other)) is None:
            assert other is not None
            run_phase(other, phase)
        log(f"{phase.name}: {reason}")
        if phase.scheduler.read_stop_request() or phase.scheduler.failure_reason(phase.scheduler.state()):
            return
