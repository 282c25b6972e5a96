"""A worker of a study: it takes a trial, runs it, tells what came of it, and takes the next, until there are enough."""

from __future__ import annotations

import time
import traceback
from collections.abc import Mapping, Sequence
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import FrozenTrial, Trial, TrialState

from armscan.checks import check_float
from armscan.errors import InvalidValueError, StorageAwayError, TrackingAwayError, listed
from armscan.files import CONFIG_FILE, SUM_TAGS
from armscan.log import say
from armscan.mistakes import mistake_in_one_line
from armscan.settings import plain
from armscan.sweeps.attempt import CONFIG_SUM, FOLDER, RUN, Attempt, composed, sum_of_config, trial_folder
from armscan.sweeps.dashboard import note_run, show_picture
from armscan.sweeps.lease import Keeper, LimitReachedError
from armscan.sweeps.parts import make_sampler
from armscan.sweeps.phases import Phase
from armscan.sweeps.tally import ENV_STEPS, FIGURES, RETRY_OF
from armscan.sweeps.values import overrides_of
from armscan.tracking import TrackedRun, abandon
from armscan.tracking.run import FAILURE_TAG, SHORT_WAIT_S

WAIT_S = 1.0
MAX_REASON_CHARS = 2000


class Worker:
    """Runs trials of one phase of a study, one after another.

    Args:
        phase: of the study.
        words: of the command line, which a trial's configuration is composed of, but for what it tries.
        keeper: holds the trial that is at hand.
    """

    def __init__(self, phase: Phase, words: Sequence[str], keeper: Keeper) -> None:
        self._phase, self._words, self._keeper = phase, words, keeper
        self._tracked: TrackedRun | None = None

    def work(self) -> str:
        """Runs trials until no further one is to be begun, and those that others run have ended; returns why."""
        ledger = self._phase.ledger
        while True:
            trial = self._keeper.claim()
            if trial is not None:
                self._run(trial)
                continue
            tally = ledger.tally()
            reason = ledger.end(tally)
            # A trial that somebody runs may yet have to be taken up again.
            if reason is not None and not tally.running:
                return reason
            time.sleep(WAIT_S)

    def _run(self, trial: Trial) -> None:
        say(f"{self._phase.name}: {_beginning(trial)}")
        try:
            figures = checked_figures(self._figures(trial), self._phase.objectives)
        except optuna.TrialPruned:
            self._tell(trial, TrialState.PRUNED)
        except UpdateFinishedTrialError:
            # Somebody has taken this worker for dead: the trial is theirs.
            self._let_go(trial)
        except LimitReachedError as limit:
            say(f"trial {trial.number} is handed back: {limit}")
            self._keeper.hand_back()
            self._tracked = None
        except TrackingAwayError:
            # For whoever finds the tracking store back.
            self._keeper.hand_back()
            raise
        except StorageAwayError:
            raise
        # Whatever else a trial raises is the trial's, and not the study's; this process is told to leave otherwise.
        except (Exception, SystemExit, KeyboardInterrupt) as error:
            line = mistake_in_one_line(error)
            if line is None:
                traceback.print_exc()
            self._fail(trial, line or repr(error))
        else:
            trial.set_user_attr(FIGURES, figures)
            self._tell(trial, TrialState.COMPLETE, [figures[name] for name in self._phase.objectives])

    def _figures(self, trial: Trial) -> dict[str, float]:
        phase = self._phase
        # By the number of the trial: workers side by side draw other points, and one alone the same ones again.
        seed = np.random.SeedSequence((phase.seed, trial.number)).generate_state(1)[0]
        trial.study.sampler = make_sampler(phase.sampler, int(seed))
        chosen = phase.space.suggest(trial)
        config, choices = composed([*self._words, *overrides_of(chosen)])
        folder = trial_folder(phase.folder, trial.number)
        folder.mkdir(parents=True, exist_ok=True)
        config_sum = sum_of_config(plain(config))
        is_gone_on_with = RUN in trial.user_attrs
        self._tracked = self._begun(trial, chosen, folder, config_sum)
        self._opened(None)
        for name, value in ((FOLDER, str(folder)), (CONFIG_SUM, config_sum)):
            if trial.user_attrs.get(name) != value:
                trial.set_user_attr(name, value)
        attempt = Attempt(
            trial=trial,
            chosen=chosen,
            composed=(config, choices),
            seeds=phase.seeds_of(trial),
            study_folder=phase.folder,
            run_id=self._tracked.run_id,
            objective=phase.reported,
            tell_progress=self._keeper.tell_progress,
            opened=self._opened,
            show_picture=partial(show_picture, trial, artifacts=phase.artifacts),
            reported=_steps_of(trial) if is_gone_on_with else set(),
        )
        try:
            return phase.run(attempt)
        finally:
            trial.set_user_attr(ENV_STEPS, attempt.env_steps)

    def _begun(self, trial: Trial, chosen: dict[str, Any], folder: Path, config_sum: str) -> TrackedRun:
        """Opens the tracked run of a trial, anew or where it was handed back."""
        phase, attributes = self._phase, trial.user_attrs
        tags = {
            "study": phase.name,
            "study.storage": phase.storage_uri,
            "trial": str(trial.number),
            SUM_TAGS[CONFIG_FILE]: config_sum,
            "folder": str(folder.resolve()),
            "overrides": " ".join(overrides_of(chosen)),
        }
        if RETRY_OF in attributes:
            tags["trial.retry_of"] = str(attributes[RETRY_OF])
        if RUN in attributes:
            tracked = TrackedRun.go_on(phase.client, attributes[RUN], folder=folder, config={}, tags=tags)
        else:
            tracked = TrackedRun.start(
                phase.client,
                phase.experiment_id,
                name=f"{phase.name}-{trial.number:04d}",
                config=chosen,
                tags=tags,
                folder=folder,
                parent_id=phase.run_id,
            )
            # Before the trial knows its run: who goes on with it makes no note any more.
            note_run(trial, phase.client, phase.experiment_id, tracked.run_id, folder)
            trial.set_user_attr(RUN, tracked.run_id)
        return tracked

    def _opened(self, training: TrackedRun | None) -> None:
        open_runs = [run for run in (training, self._tracked) if run is not None]
        self._keeper.closing(partial(_close, open_runs))

    def _tell(self, trial: Trial, state: TrialState, values: Sequence[float] | None = None) -> None:
        with self._keeper.ending():
            try:
                trial.study.tell(trial, values, state)
            # Its own error, and that of a trial which is not running any more.
            except (UpdateFinishedTrialError, ValueError):
                self._let_go(trial)
                return
        named = dict(zip(self._phase.objectives, values or (), strict=False))
        shown = ", ".join(f"{name} {value:.4g}" for name, value in named.items())
        say(f"trial {trial.number} {state.name.lower()} {shown}".rstrip())
        if self._tracked is not None:
            self._tracked.log_figures(trial.user_attrs.get(FIGURES, {}), n_env_steps=0)
            if state == TrialState.PRUNED:
                self._tracked.set_tags({"pruned": "true"})
            self._tracked.end("FINISHED")
        self._tracked = None

    def _fail(self, trial: Trial, reason: str) -> None:
        say(f"trial {trial.number} failed: {reason}")
        with self._keeper.ending():
            self._phase.ledger.fail(trial, reason[:MAX_REASON_CHARS])
        if self._tracked is not None:
            self._tracked.end("FAILED", reason=reason)
        self._tracked = None

    def _let_go(self, trial: Trial) -> None:
        say(f"trial {trial.number} was taken over by another worker")
        if self._tracked is not None:
            self._tracked.end("FAILED", reason="taken over by another worker")
        self._tracked = None


def checked_figures(figures: Any, objectives: Sequence[str]) -> dict[str, float]:
    """Returns what a task has returned.

    Args:
        figures: by name; those that are no objectives may be NaN.
        objectives: the names of those that must be there, and finite.

    Raises:
        InvalidValueError: if it is anything else.
    """
    if not isinstance(figures, Mapping):
        raise InvalidValueError(f"the task has returned {figures!r}, but it must be figures by their names")
    if missing := [name for name in objectives if name not in figures]:
        raise InvalidValueError(f"the task has not returned {missing[0]}, but only {listed(list(figures))}")
    for name, figure in figures.items():
        if name in objectives:
            check_float(f"what the task has returned as {name}", figure)
        elif not isinstance(figure, Real):
            raise InvalidValueError(f"what the task has returned as {name} is {figure!r}, but it must be a number")
    return {str(name): float(figure) for name, figure in figures.items()}


def close_runs_of(trial: FrozenTrial, phase: Phase) -> None:
    """Closes what a dead worker has left open in the tracking store, but for what a retry has taken over since."""
    abandon(trial_folder(phase.folder, trial.number), phase.client, "its worker died")


def close_orphans(phase: Phase) -> None:
    """Closes runs of trials that failed, because their workers died before they could leave word of the run."""
    running = phase.client.search_runs(
        [phase.experiment_id], f"tags.study = '{phase.name}' AND attributes.status = 'RUNNING'"
    )
    tally = phase.ledger.tally()
    failed = {str(trial.number) for trial in (*tally.failed, *tally.retried)}
    for run in running:
        if run.data.tags.get("trial") in failed:
            phase.client.set_tag(run.info.run_id, FAILURE_TAG, "its worker died")
            phase.client.set_terminated(run.info.run_id, "FAILED")


def _steps_of(trial: Trial) -> set[int]:
    return set(trial.storage.get_trial(trial._trial_id).intermediate_values)


def _beginning(trial: Trial) -> str:
    attributes = trial.user_attrs
    if RUN in attributes:
        return f"trial {trial.number} is gone on with"
    again = f", in the place of trial {attributes[RETRY_OF]}" if RETRY_OF in attributes else ""
    return f"trial {trial.number} begins{again}"


def _close(runs: Sequence[TrackedRun]) -> None:
    for run in runs:
        run.end("KILLED", reason="handed back", wait_s=SHORT_WAIT_S)
