"""Round trips of a worker to its storage, which many workers share."""

import threading

from armscan.sweeps.workers import worker as worker_module
from benchmarks.sweeps.scaling import compose_run, phase_of, round_trips_counted, work


def test_worker_goes_to_the_storage_twelve_times_for_a_trial_with_ten_reports(postgres, tmp_path, monkeypatch):
    monkeypatch.setattr(worker_module, "compose_run", compose_run)
    uri, here, counts = postgres.make_database(), threading.get_ident(), []
    for n_trials in (3, 8):
        phase = phase_of(uri, None, tmp_path, n_trials)
        with round_trips_counted() as trips:
            work(phase, "a")
        counts.append(trips[here])
        trials = phase.scheduler.study.get_trials()
        assert [trial.state.name for trial in trials] == ["COMPLETE"] * n_trials
        assert all(len(trial.intermediate_values) == 10 for trial in trials)
    # The first start runs three trials and the second five; both then find that there are no more.
    assert counts[1] - counts[0] == 12 * 2
