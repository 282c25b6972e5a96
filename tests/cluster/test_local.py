"""The same study with its workers on this machine."""

from tests.cluster.studies import WAITING


def test_study_outlives_a_killed_worker_and_tests_its_best(start):
    words = ["study.workers=2", "study.n_trials=4", "study.final_eval.top_k=1"]
    words += [f"study.final_eval.{name}_seeds=2" for name in ("min", "mean", "test")]
    study = start(*WAITING, *words, environment={})
    study.kill_worker(1)
    assert study.end() == 0, study.told()
    study.check_complete(4)
    study.check_secret()
    assert [trial.state.name for trial in study.trials() if trial.state.name == "FAIL"] == ["FAIL"]
    tested = study.trials("sac_y-judged")
    selected = study.trials("sac_y-selection")
    assert {trial.state.name for trial in (*selected, *tested)} == {"COMPLETE"}
    # The candidate and the control, then the chosen one and the control, or the control alone.
    assert len(selected) == 4
    assert len(tested) in (2, 4)
    printed = study.printed.read_text()
    assert ("No setting beat the control" in printed) == (len(tested) == 2)
