"""What dead workers have left open in the tracking store, closed by those who are alive."""

from __future__ import annotations

from optuna.trial import FrozenTrial

from armscan.sweeps.attempt import trial_folder
from armscan.sweeps.phases import Phase
from armscan.tracking import abandon
from armscan.tracking.run import FAILURE_TAG

WORKER_DIED = "its worker died"


def close_runs_of(trial: FrozenTrial, phase: Phase) -> None:
    """Closes what a dead worker has left open in the tracking store, but for what a retry has taken over since."""
    abandon(trial_folder(phase.folder, trial.number), phase.client, WORKER_DIED)


def close_orphans(phase: Phase) -> None:
    """Closes runs of trials that failed, because their workers died before they could leave word of the run."""
    running = phase.client.search_runs(
        [phase.experiment_id], f"tags.study = '{phase.name}' AND attributes.status = 'RUNNING'"
    )
    tally = phase.ledger.tally()
    failed = {str(trial.number) for trial in (*tally.failed, *tally.retried)}
    for run in running:
        if run.data.tags.get("trial") in failed:
            phase.client.set_tag(run.info.run_id, FAILURE_TAG, WORKER_DIED)
            phase.client.set_terminated(run.info.run_id, "FAILED")
