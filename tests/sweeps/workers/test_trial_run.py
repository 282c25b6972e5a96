"""The tracked run of a trial."""

from optuna.trial import TrialState

from armscan.sweeps.scheduling.claim import PendingWrites
from armscan.sweeps.storage.attribute_names import METRICS, RUN
from armscan.sweeps.tasks.folders import trial_folder
from armscan.sweeps.workers.trial_run import end_runs_left_open, open_run
from armscan.tracking.sync import PROCESS_DIED
from armscan.tracking.tags import FAILURE_TAG, PRUNED_TAG
from armscan.utils.run_files import LAST_CHECKPOINT


def test_outcome_of_a_trial_whose_worker_died_after_the_storage_had_it_is_tracked(opened):
    phase = opened().search
    study, store = phase.scheduler.study, opened.store[0]
    run_ids, checkpoints = [], []
    for state, value in ((TrialState.COMPLETE, 1.5), (TrialState.PRUNED, None), (None, None)):
        trial = study.ask()
        tracked = open_run(phase, trial, {"agent.lr": 1e-3}, "0" * 64, PendingWrites())
        trial.set_user_attr(RUN, tracked.run_id)
        folder = trial_folder(phase.folder, trial.number) / "seed_0"
        folder.mkdir(parents=True)
        checkpoints.append(folder / LAST_CHECKPOINT)
        checkpoints[-1].touch()
        if state is not None:
            trial.set_user_attr(METRICS, {} if value is None else {"mean_steps": value})
            study.tell(trial, value, state=state)
        run_ids.append(tracked.run_id)
        tracked.end("FAILED", reason=PROCESS_DIED)
    end_runs_left_open(phase)
    complete, pruned, running = (store.get_run(run_id) for run_id in run_ids)
    assert [each.info.status for each in (complete, pruned, running)] == ["FINISHED", "FINISHED", "FAILED"]
    assert complete.data.metrics["mean_steps"] == 1.5
    assert pruned.data.tags[PRUNED_TAG] == "true"
    assert [FAILURE_TAG in each.data.tags for each in (complete, pruned, running)] == [False, False, True]
    assert [each.exists() for each in checkpoints] == [False, False, True]
