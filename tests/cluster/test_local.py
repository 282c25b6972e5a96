"""The same study with its workers on this machine."""

from tests.cluster.studies import WAITING


def test_study_outlives_a_killed_worker_and_judges_its_best(start):
    study = start(*WAITING, "study.workers=2", "study.n_trials=4", "study.final_eval.top_k=1", environment={})
    study.kill_worker(1)
    assert study.end() == 0, study.told()
    study.check_complete(4)
    study.check_secret()
    assert [trial.state.name for trial in study.trials() if trial.state.name == "FAIL"] == ["FAIL"]
    judged = study.trials("sac_y-judged")
    assert {trial.state.name for trial in judged} == {"COMPLETE"}
    assert f"result on the test volumes, with {len(judged)} other seed(s) each" in study.printed.read_text()
