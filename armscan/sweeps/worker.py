"""A worker of a study: it takes a trial, runs it, tells what came of it, and takes the next, until there are enough."""

from __future__ import annotations

import time
import traceback
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import Trial, TrialState

from armscan.errors import StorageAwayError, TrackingAwayError
from armscan.files import CONFIG_FILE, SUM_TAGS
from armscan.log import say
from armscan.mistakes import mistake_in_one_line
from armscan.settings import MULTIRUN, plain, run_command
from armscan.sweeps.attempt import CONFIG_SUM, FOLDER, RUN, Attempt, composed, sum_of_config, trial_folder
from armscan.sweeps.dashboard import note_run, show_picture
from armscan.sweeps.figures import checked_figures
from armscan.sweeps.lease import Keeper, LimitReachedError
from armscan.sweeps.outcome import Once, Outcome
from armscan.sweeps.parts import make_sampler
from armscan.sweeps.phases import Phase
from armscan.sweeps.tally import ENV_STEPS, FAILURE, FIGURES, RETRY_OF
from armscan.sweeps.values import overrides_of
from armscan.tracking import TrackedRun
from armscan.tracking.run import SHORT_WAIT_S

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
        outcome: Outcome | None = None
        conclude: Once | None = None
        while True:
            # One way to the storage for the trial before and the next: with many workers it is these that add up.
            trial = self._keeper.claim(outcome, conclude)
            if conclude is not None:
                conclude()
                self._keeper.closing(None)
            outcome, conclude = None, None
            if trial is not None:
                outcome = self._run(trial)
                conclude = Once(partial(self._conclude, outcome, self._tracked)) if outcome else None
                self._tracked = None
            elif reason := self._waited():
                return reason

    def _waited(self) -> str | None:
        """Waits until there is a trial to be had; returns why there will be none any more."""
        ledger = self._phase.ledger
        while True:
            tally = ledger.tally()
            reason = ledger.end(tally)
            # A trial that somebody runs may yet have to be taken up again.
            if reason is not None and not tally.running:
                return reason
            if ledger.has_more(tally):
                return None
            time.sleep(WAIT_S)

    def _run(self, trial: Trial) -> Outcome | None:
        """Runs a trial; returns what came of it, None where that is for others to say."""
        say(f"{self._phase.name}: {_beginning(trial)}")
        notes = self._keeper.notes
        try:
            figures = checked_figures(self._figures(trial), self._phase.objectives)
        except optuna.TrialPruned:
            return Outcome(trial, TrialState.PRUNED, notes)
        except UpdateFinishedTrialError:
            # Somebody has taken this worker for dead: the trial is theirs.
            self._let_go(trial, self._tracked)
            self._keeper.closing(None)
        except LimitReachedError as limit:
            say(f"trial {trial.number} is handed back: {limit}")
            self._keeper.hand_back()
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
            reason = (line or repr(error))[:MAX_REASON_CHARS]
            return Outcome(trial, TrialState.FAIL, notes, attributes={FAILURE: reason})
        else:
            values = [figures[name] for name in self._phase.objectives]
            return Outcome(trial, TrialState.COMPLETE, notes, values, {FIGURES: figures})
        return None

    def _figures(self, trial: Trial) -> dict[str, float]:
        phase, notes = self._phase, self._keeper.notes
        # By the number of the trial: workers side by side draw other points, and one alone the same ones again.
        seed = np.random.SeedSequence((phase.seed, trial.number)).generate_state(1)[0]
        trial.study.sampler = make_sampler(phase.sampler, int(seed))
        chosen = self._suggested(trial)
        config, choices = composed([*self._words, *overrides_of(chosen)])
        folder = trial_folder(phase.folder, trial.number)
        folder.mkdir(parents=True, exist_ok=True)
        config_sum = sum_of_config(plain(config))
        is_gone_on_with = RUN in trial.user_attrs
        self._tracked = self._begun(trial, chosen, folder, config_sum)
        self._opened(None)
        for name, value in ((FOLDER, str(folder)), (CONFIG_SUM, config_sum)):
            if trial.user_attrs.get(name) != value:
                notes.add(partial(trial.set_user_attr, name, value))
        attempt = Attempt(
            trial=trial,
            chosen=chosen,
            composed=(config, choices),
            command=run_command([MULTIRUN[0], *self._words]),
            seeds=phase.seeds_of(trial),
            study_folder=phase.folder,
            run_id=self._tracked.run_id,
            objective=phase.reported,
            tell_progress=self._keeper.tell_progress,
            opened=self._opened,
            show_picture=lambda picture: notes.add(partial(show_picture, trial, picture, phase.artifacts)),
            reported=_steps_of(trial) if is_gone_on_with else set(),
            notes=notes,
            together=phase.ledger.together,
        )
        try:
            return phase.run(attempt)
        finally:
            notes.add(partial(trial.set_user_attr, ENV_STEPS, attempt.env_steps))

    def _suggested(self, trial: Trial) -> dict[str, Any]:
        """Returns what a trial tries, drawn and written at once."""

        def suggested() -> dict[str, Any]:
            # Anew each time: what a trial has noted as written may have been lost with the connection.
            return self._phase.space.suggest(Trial(trial.study, trial._trial_id))

        return self._phase.ledger.together(suggested)

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
            noted = partial(note_run, trial, phase.client, phase.experiment_id, tracked.run_id, folder)
            for write in (noted, partial(trial.set_user_attr, RUN, tracked.run_id)):
                self._keeper.notes.add(write)
        return tracked

    def _opened(self, training: TrackedRun | None) -> None:
        open_runs = [run for run in (training, self._tracked) if run is not None]
        self._keeper.closing(partial(_close, open_runs))

    def _conclude(self, outcome: Outcome, tracked: TrackedRun | None) -> None:
        """Says what came of a trial, once the storage knows it."""
        trial, state = outcome.trial, outcome.state
        if not outcome.is_told:
            self._let_go(trial, tracked)
            return
        figures = outcome.attributes.get(FIGURES, {})
        shown = ", ".join(f"{name} {figures[name]:.4g}" for name in self._phase.objectives if name in figures)
        reason = outcome.attributes.get(FAILURE)
        say(f"trial {trial.number} " + (f"failed: {reason}" if reason else f"{state.name.lower()} {shown}".rstrip()))
        if tracked is None:
            return
        tracked.log_figures(figures, n_env_steps=0)
        if state == TrialState.PRUNED:
            tracked.set_tags({"pruned": "true"})
        tracked.end("FAILED" if reason else "FINISHED", reason=reason)

    def _let_go(self, trial: Trial, tracked: TrackedRun | None) -> None:
        say(f"trial {trial.number} was taken over by another worker")
        if tracked is not None:
            tracked.end("FAILED", reason="taken over by another worker")


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
