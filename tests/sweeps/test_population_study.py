"""Population-based training as a user starts it: real workers, killed at random moments."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter

import pytest

from armscan.sweeps.tasks.folders import trial_folder
from armscan.training import load_checkpoint
from armscan.utils.processes import ProcessInfo
from tests.support.processes import start_run
from tests.support.tensors import assert_same_tensors
from tests.support.waiting import HANG_S, wait_until
from tests.sweeps.test_command import trials_of

N_MEMBERS, N_GENERATIONS, N_KILLS = 4, 3, 12
SWEEP = """
# @package _global_
defaults:
  - /study/base
  - override /study/sampler: pbt
  - override /study/pruner: none
  - _self_

projection: y
data: {n_training: 1, n_validation: 1, n_test: 1}
agent: {num_envs: 4, learning_starts: 100, batch_size: 32}
training: {env_steps: 1200, eval_every_env_steps: 200, validation_episodes: 4, solved: null}
evaluation: {episodes: 4}
device: cpu
study:
  name: tiny
  n_trials: 12
  max_retries: 20
  objectives: [maximize mean_return]
  sampler: {population: 4, interval_env_steps: 400}
  space:
    agent.lr: {low: 2.0e-4, high: 5.0e-3, log: true}
    agent.gamma: {low: 0.5, high: 0.95}
    agent.batch_size: {choices: [16, 32, 64]}
    agent.ent_coef_lr: {low: 1.0e-4, high: 1.0e-2, log: true}
  final_eval: {top_k: 0}
"""


def kill_a_worker(folder, process, drawn, n_complete):
    """Kill a worker once `n_complete` trials are complete: when it has claimed one, opened its run, or reported."""
    moment = drawn.choice(["claimed", "opened", "reported"])

    def holders():
        trials = trials_of(folder, "tiny")
        if sum(trial.state.name == "COMPLETE" for trial in trials) < n_complete:
            return []
        return [
            trial.user_attrs["lease"]["pid"]
            for trial in trials
            if trial.state.name == "RUNNING" and ProcessInfo.of(trial.user_attrs["lease"]).is_alive
            if moment != "opened" or (trial_folder(folder / "studies/tiny", trial.number) / "seed_0/run.json").exists()
            if moment != "reported" or trial.intermediate_values
        ]

    wait_until(holders, process=process, log=(folder / "printed").read_text)
    pids = holders()
    time.sleep(drawn.uniform(0.0, 0.5))
    # The trial may be complete by then, and its worker at the next.
    os.kill(drawn.choice(pids), signal.SIGKILL)


def replayed(folder, trial):
    """Replay a member with the command that a study prints; return its output, and the weights of both."""
    of_trial = folder / trial.user_attrs["folder"] / "seed_0"
    run_id = json.loads((of_trial / "run.json").read_text())["run_id"]
    again = folder / f"again-{trial.number}"
    command = [sys.executable, "-m", "armscan", "runs", "reproduce", run_id, "--out", str(again)]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout, load_checkpoint(of_trial / "best.pt")[0], load_checkpoint(again / "best.pt")[0]


@pytest.mark.slow
def test_population_loses_no_member_to_kills_and_each_schedule_replays_to_the_same_weights(tmp_path):
    (tmp_path / "sweeps").mkdir()
    (tmp_path / "sweeps" / "tiny.yaml").write_text(SWEEP.lstrip())
    drawn = random.Random(5)
    process = start_run("-m", "sweep=tiny", cwd=tmp_path)
    try:
        for n_complete in range(N_KILLS):
            kill_a_worker(tmp_path, process, drawn, n_complete)
        assert process.wait(HANG_S) == 0, (tmp_path / "printed").read_text()
    finally:
        process.kill()
    trials = trials_of(tmp_path, "tiny")
    complete = [trial for trial in trials if trial.state.name == "COMPLETE"]
    places = Counter((trial.user_attrs["generation"], trial.user_attrs["member"]) for trial in complete)
    assert places == {(each, member): 1 for each in range(N_GENERATIONS) for member in range(N_MEMBERS)}
    others = [trial for trial in trials if trial not in complete]
    # Each death is retried; some workers die between two trials.
    assert {trial.state.name for trial in others} == {"FAIL"}
    assert all(trial.user_attrs["retried"] for trial in others)
    assert N_KILLS // 2 <= len(others) <= N_KILLS
    for trial in complete:
        if trial.user_attrs["generation"]:
            parent = trials[trial.user_attrs["parent"]]
            assert parent in complete
            assert parent.user_attrs["generation"] == trial.user_attrs["generation"] - 1
            assert trial.user_attrs["schedule"][: len(parent.user_attrs["schedule"])] == parent.user_attrs["schedule"]
        assert trial.user_attrs["env_steps"] == {0: 516, 1: 416, 2: 272}[trial.user_attrs["generation"]]
    assert not list(tmp_path.glob("studies/tiny/trials/*/seed_0/last.pt"))
    told = re.findall(r"^replay +armscan runs reproduce (\w+)", (tmp_path / "printed").read_text(), re.MULTILINE)
    last = [trial for trial in complete if trial.user_attrs["generation"] == N_GENERATIONS - 1]
    best = max(last, key=lambda trial: trial.value)
    assert told == [json.loads((tmp_path / best.user_attrs["folder"] / "seed_0" / "run.json").read_text())["run_id"]]
    # The best, and one whose values have changed most often.
    changed_most = max(last, key=lambda trial: len(trial.user_attrs["schedule"]))
    for trial in [best, *([changed_most] if changed_most is not best else [])]:
        said, first, second = replayed(tmp_path, trial)
        assert "to the last bit" in said
        assert_same_tensors(first, second)
