"""The command, as a user types it."""

import json
import os
import shlex
import signal
import subprocess
from collections import Counter
from pathlib import Path

import mlflow.pyfunc
import psutil
import pytest
import torch
from mlflow import MlflowClient

from armscan.utils.files import sha256
from armscan.utils.run_files import folder_lock
from tests.support import FEW_VOLUMES, REPOSITORY
from tests.support.processes import COMMAND, start_run
from tests.support.waiting import HANG_S, wait_until

SMALL = [
    *FEW_VOLUMES,
    "training.env_steps=400",
    "training.eval_every_env_steps=200",
    "training.validation_episodes=2",
    "evaluation.episodes=3",
    "env.max_steps=8",
    "agent.learning_starts=100",
    "agent.batch_size=32",
    "network=mlp",
    "network.hidden_sizes=[16]",
    # It takes longer than the training.
    "tracking.policy=false",
]
# For an agent that does not learn.
FEW = [word for word in SMALL if word.startswith(("data.", "evaluation.", "env."))]
# Metrics that no two runs share.
TIMES = ("wall_s", "speed/", "system/")


def armscan_run(*arguments, cwd, **environment):
    """Run the command in its own process."""
    return subprocess.run(
        [*COMMAND, *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        env=os.environ | environment,
        check=False,
    )


def runs_in(folder):
    client = MlflowClient(tracking_uri=f"sqlite:///{folder}/mlruns.db")
    experiment = client.get_experiment_by_name("armscan")
    return client, client.search_runs([experiment.experiment_id])


@pytest.mark.full
def test_run_trains_evaluates_and_tracks(tmp_path, monkeypatch):
    words = [*SMALL, "seed=3", "tracking.policy=true"]
    ended = armscan_run(*words, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ""
    for word in ("400/400 steps", "on plane", "success", "left", "test volumes", "armscan ui", "episode.gif"):
        assert word in ended.stdout
    client, (tracked,) = runs_in(tmp_path)
    assert f"run {tracked.info.run_id}: sac-cluster-y-phantom-seed3" in ended.stdout
    assert f"armscan evaluate {tracked.info.run_id}" in ended.stdout
    assert tracked.info.status == "FINISHED"
    assert tracked.data.params["network.hidden_sizes"] == "[16]"
    assert tracked.data.params["env.transform.rz_deg"] == "10.0"
    assert {"git.commit", "git.dirty", "overrides"} <= tracked.data.tags.keys()
    assert tracked.data.tags["seed"] == "3"
    assert tracked.data.tags["command"] == shlex.join(["python", "-m", "armscan.run", *words])
    assert tracked.data.tags["version.torch"] == torch.__version__
    assert tracked.data.tags["constraints.sha256"] == sha256((REPOSITORY / "constraints.txt").read_bytes())
    logged = {
        "validation/mean_return",
        "validation/mean_steps",
        "validation/success_rate",
        "train/return",
        "train/length",
    }
    logged |= {"train/success_rate", "update/actor_loss", "update/critic_loss", "update/entropy_coefficient"}
    logged |= {"speed/updates_per_s", "speed/env_steps_per_s", "replay_size", "wall_s"}
    assert logged <= tracked.data.metrics.keys()
    assert {"system/cpu_utilization_percentage", "system/system_memory_usage_megabytes"} <= tracked.data.metrics.keys()
    assert tracked.info.run_name == "sac-cluster-y-phantom-seed3"
    (folder,) = (tmp_path / "outputs").glob("*/*")
    prints = json.loads((folder / "volumes.json").read_text())
    assert tracked.data.tags["volumes.test"] == f"phantom-2000000:{prints['test']['phantom-2000000'][:16]}"
    for volumes in ("training_volumes", "test_volumes"):
        for figure in ("success_rate", "mean_steps", "mean_distance_mm", "mean_distance_deg"):
            assert f"{volumes}/{figure}" in tracked.data.metrics
    steps = [point.step for point in client.get_metric_history(tracked.info.run_id, "validation/mean_return")]
    assert steps == sorted(set(steps))
    assert steps[-1] >= 400
    artifacts = {file.path for file in client.list_artifacts(tracked.info.run_id)}
    # And a diff, if the code differs from its commit.
    assert artifacts - {"code.diff"} == {
        *("best.pt", "last.pt", "config.yaml", "volumes.json", "environment.json"),
        *("episode.gif", "evaluation.json", "baselines.json", "results.html", "learning_curve.png", "policy"),
    }
    assert ("code.diff" in artifacts) == (tracked.data.tags["git.dirty"] == "true")
    assert tracked.data.tags["policy"] == "kept"
    with monkeypatch.context() as patched:
        patched.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/mlruns.db")
        model = mlflow.pyfunc.load_model(f"runs:/{tracked.info.run_id}/policy")
    assert model.predict(model.input_example).shape == (2, 1)
    evaluation = json.loads((folder / "evaluation.json").read_text())
    assert len(evaluation["test volumes"]["episodes"]) == 3


@pytest.mark.full
@pytest.mark.usefixtures("database")
def test_run_of_the_same_seed_gives_the_same_figures(tmp_path):
    for _ in range(2):
        assert armscan_run(*SMALL, "seed=3", cwd=tmp_path).returncode == 0
    first, second = (
        {name: value for name, value in tracked.data.metrics.items() if not name.startswith(TIMES)}
        for tracked in runs_in(tmp_path)[1]
    )
    assert first == second


@pytest.mark.full
@pytest.mark.usefixtures("database")
def test_run_says_when_it_validates_where_the_agent_takes_more_steps_at_once_than_an_epoch_has(tmp_path):
    words = [word for word in SMALL if not word.startswith("agent.learning_starts")]
    ended = armscan_run(*words, "agent=ppo", "agent.env_steps_per_collection=250", cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert "validating every 256 environment steps, which the agent takes at once" in ended.stdout
    assert "training.eval_every_env_steps = 200" in ended.stdout
    assert "512/512 steps" in ended.stdout


@pytest.mark.full
@pytest.mark.usefixtures("database")
def test_multirun_runs_its_jobs_as_children_and_a_failed_one_stops_no_other(tmp_path):
    varied = ["-m", "obs=cluster,action_reward", "env.success_threshold=0.05,7"]
    ended = armscan_run(*varied, "projection=zy", "stack=2", "memory=1", *SMALL, cwd=tmp_path)
    assert ended.returncode == 1
    assert "Traceback" not in ended.stderr
    assert "success_threshold is 7, but it must be a finite number above 0 and at most 1" in ended.stderr
    assert "run it alone with: python -m armscan.run obs=cluster env.success_threshold=7" in ended.stderr
    assert "all runs  armscan ui\n" in ended.stdout
    tracked = runs_in(tmp_path)[1]
    (parent,) = [each for each in tracked if each.info.run_name.startswith("grid")]
    assert f"compare   armscan report --runs {parent.info.run_id}\n" in ended.stdout
    children = [each for each in tracked if each is not parent]
    assert parent.info.status == "FAILED"
    assert parent.data.tags["failure.1"].startswith("obs=cluster env.success_threshold=7: success_threshold is 7")
    assert [child.data.tags["mlflow.parentRunId"] for child in children] == [parent.info.run_id] * 2
    assert {child.info.status for child in children} == {"FINISHED"}
    table = ended.stdout[ended.stdout.index("jobs (") :]
    assert all(child.info.run_id[:8] in table for child in children)
    assert {child.data.tags["choice.obs"] for child in children} == {"cluster", "action_reward"}
    assert len(list((tmp_path / "multirun").glob("*/*/*/best.pt"))) == 2
    assert f"resume all with: python -m armscan.run resume={parent.info.run_id}\n" in ended.stderr
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    words = [f"resume={parent.info.run_id}", "--trust", f"tracking.uri=sqlite:///{tmp_path}/mlruns.db"]
    again = armscan_run(*words, cwd=elsewhere)
    assert not list(elsewhere.iterdir())
    assert again.returncode == 1
    # What has finished is not run again; what failed is.
    assert again.stdout.count("has finished before: run") == 2
    assert again.stdout.count("run it alone") + again.stderr.count("run it alone") == 2
    runs = runs_in(tmp_path)[1]
    parents = [each for each in runs if each.info.run_name.startswith("grid")]
    assert len(runs) == len(parents) + 2 == 4
    (old_parent,) = [each for each in parents if each.info.run_id == parent.info.run_id]
    (new_parent,) = [each for each in parents if each is not old_parent]
    assert old_parent.data.tags["continued_by"] == new_parent.info.run_id
    adopted = [each.data.tags["mlflow.parentRunId"] for each in runs if each not in parents]
    assert adopted == [new_parent.info.run_id] * 2
    for child in children:
        assert f"{child.data.metrics['test_volumes/on_plane_5mm_10deg']:.1%}" in again.stdout


@pytest.mark.full
@pytest.mark.usefixtures("database")
def test_folds_are_a_grid_with_one_table_over_all_of_them(tmp_path, data_folder):
    few = ["agent=random", "evaluation.episodes=2", "tracking.policy=false"]
    words = ["data=nifti", f"data.path={data_folder}", "data.folds=2", "data.validation=0.25", *few]
    ended = armscan_run(*words, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    tracked = runs_in(tmp_path)[1]
    (parent,) = [each for each in tracked if each.info.run_name.startswith("grid")]
    children = [each for each in tracked if each is not parent]
    assert len(children) == 2
    table = ended.stdout[ended.stdout.index("all folds (test)") :]
    assert "agent," in table
    assert "random," in table
    # Each of the four wrists is tested on once.
    assert parent.data.metrics["test_volumes/volumes"] == 4
    assert parent.data.metrics["test_volumes/episodes"] == 4
    mean = sum(child.data.metrics["test_volumes/mean_steps"] for child in children) / 2
    assert parent.data.metrics["test_volumes/mean_steps"] == pytest.approx(mean)
    assert list((tmp_path / "multirun").glob("*/*/results.html"))


@pytest.mark.full
@pytest.mark.usefixtures("database")
def test_grid_that_configures_hydra_says_that_resuming_it_needs_trust(tmp_path):
    ended = armscan_run("-m", "seed=0,-1", "agent=random", "hydra.launcher.n_jobs=1", *FEW, cwd=tmp_path)
    assert ended.returncode == 1
    (hint,) = [line for line in ended.stderr.splitlines() if line.startswith("resume all with: ")]
    assert hint.endswith(" --trust")
    again = armscan_run(*shlex.split(hint)[6:], cwd=tmp_path)
    assert again.returncode == 1
    assert again.stdout.count("has finished before: run") == 1


@pytest.mark.full
@pytest.mark.usefixtures("database")
def test_agents_that_do_not_learn_are_evaluated_and_tracked_side_by_side(tmp_path):
    few = [word for word in SMALL if not word.startswith(("agent.", "network"))]
    ended = armscan_run("-m", "agent=exhaustive,optuna", "projection=zy", *few, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert "Traceback" not in ended.stderr
    client, tracked = runs_in(tmp_path)
    children = [each for each in tracked if "choice.agent" in each.data.tags]
    assert len(children) == 2
    (parent,) = [each for each in tracked if each not in children]
    assert [file.path for file in client.list_artifacts(parent.info.run_id)] == ["results.html"]
    (page,) = tmp_path.glob("multirun/*/*/results.html")
    assert "<h1>Grid of 2 jobs</h1>" in page.read_text()
    for child in children:
        assert child.info.status == "FINISHED"
        assert child.info.run_name == f"{child.data.tags['choice.agent']}-cluster-zy-phantom-seed0"
        assert {"training_volumes/success_rate", "test_volumes/mean_distance_deg"} <= child.data.metrics.keys()
        artifacts = {file.path for file in client.list_artifacts(child.info.run_id)}
        kept = {"config.yaml", "volumes.json", "environment.json", "episode.gif"}
        kept |= {"evaluation.json", "baselines.json", "results.html"}
        assert artifacts - {"code.diff"} == kept


@pytest.mark.full
@pytest.mark.usefixtures("database")
def test_run_trains_on_labelmap_files(tmp_path, data_folder):
    arguments = ["data=nifti", f"data.path={data_folder}", *(word for word in SMALL if not word.startswith("data."))]
    ended = armscan_run(*arguments, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert runs_in(tmp_path)[1][0].data.tags["choice.data"] == "nifti"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["obs=foo"], "obs is 'foo', but it must be action_reward, cluster"),
        (["agent=foo"], "agent is 'foo', but it must be "),
        (["agent.lrr=1"], "there is no key 'lrr' in agent, but only network, lr, "),
        (["agent=exhaustive", "projection=x"], "agent.swept is ['ty'], but ty is not free; projection leaves only tx"),
        (["agent=optuna", "agent.sampler=x"], "agent.sampler is 'x', but it must be tpe, cmaes or gp"),
        (["agnet=sac"], "there is no key 'agnet' at the top, but only data, obs, reward, network, agent, "),
        (["+agent.foo=1"], "Error in call to target 'armscan.agents.sac.SAC': TypeError(\"SAC.__init__() got an unex"),
        (["data=nifti", "data.pth=x"], "there is no key 'pth' in data, but only path, validation, test, split_seed"),
        (["data=nifti"], "data.path is not set"),
        (["data=nifti", "data.path=/nowhere"], "/nowhere: the folder of volumes does not exist"),
        (["seed=["], "the value of seed cannot be read: [; quote strings in it: seed=\"['a b']\""),
        (["seed"], "'seed' cannot be read: what follows the options must be key=value"),
        (["foo"], "'foo' cannot be read"),
        (["obs=null"], "Config group override must be a string or a list. Got NoneType"),
        (["obs=[cluster,slice]"], "'obs=[cluster,slice]' is not allowed: a run has one obs, obs=NAME"),
        (["+foo=1"], "there is no key 'foo' at the top, but only data, obs, "),
        (["+evaluation.seed=4"], "there is no key 'seed' in evaluation, but only episodes"),
        (["network.images=null"], "network.images is None, but it must have the methods of Network"),
        (["agent.network=mlp"], "network is 'mlp', but it must have the methods of Network, for_space first; on the"),
        (["agent._target_=builtins.dict"], "agent is {"),
        (["compute.precision=half"], "compute.precision is 'half', but it must be float32 or bfloat16"),
        (
            ["agent=exhaustive_grid", "projection=zy", "agent.step_mm=0.01", "agent.step_deg=0.01"],
            "agent.step_mm is 0.01 and agent.step_deg is 0.01, which give ",
        ),
        (["obs=cluster,action_reward"], "'obs=cluster,action_reward' gives several values: armscan run -m"),
        (["agent=[sac,ppo]"], "'agent=[sac,ppo]' is not allowed: a run has one agent, agent=NAME"),
        (["-m", "agent=glob([rand*])", "seed=-1"], "seed is -1, but it must be"),
        (["~data"], "'~data' is not allowed: a run has one data, data=NAME"),
        (["-m", "+sweep=sac_y"], "'+sweep=sac_y' is not allowed: a study is sweep=NAME"),
        (["-m", "sweep/lab=mine", "--plan"], "'sweep/lab=mine' is not allowed: a study is sweep=NAME"),
        (["-m", "obs=[cluster],slice", "--plan"], "'obs=[cluster],slice' is not allowed: a run has one obs"),
        (
            ["data.path=wrists"],
            "there is no key 'path' in data, but only n_training, n_validation, n_test, first_seed, cache_dir or "
            "version: data.path needs data=nifti or data=mixed",
        ),
        (["agent=plane_finder", "network=mlp"], "'network=mlp' has no effect: agent=plane_finder has a network of its"),
        (["-m", "agent=plane_finder", "network=mlp,auto"], "'network=mlp' has no effect: agent=plane_finder has"),
        (["seed=-1"], "seed is -1, but it must be a whole number of at least 0"),
        (["stack=0"], "stack is 0, but it must be a whole number of at least 1"),
        (
            ["projection=q"],
            "projection is 'q', but it must be x, y, xy, zy or full, or a list of different ones of rz, rx, tx or ty",
        ),
        (["env.transform=3"], "transform is 3, but it must be a RandomTransform or None"),
        (["agent.lr=fast"], "agent.lr is 'fast', but it must be a finite number above 0"),
        (["training.env_steps=abc"], "training.env_steps is 'abc', but it must be a whole number of at least 1"),
        (["training=null"], "training is None, but it must be a section"),
        (["training.solved=3"], "training.solved is 3, but it must be a SolvedCriterion or null"),
        (["reward.targets=3"], "targets is 3, but it must be 3 whole numbers"),
        (["env.observation=3"], "observation is 3, but it must be action_reward, cluster"),
        (["projection=null"], "projection is None, but it must be x, y, xy, zy or full"),
        (
            ["seed=99999999999999999999"],
            "seed is 99999999999999999999, but it must be a whole number of at least 0 and",
        ),
        (["data.cache_dir=/dev/null"], "/dev/null: phantoms cannot be kept there"),
        (["data.cache_dir=[1]"], "data.cache_dir is [1], but it must be the path of a file or folder"),
        (["data=nifti", "data.path=null"], "data.path is None, but it must be the path of a file or folder"),
        (["device=tpu"], "device is 'tpu', but it must be auto, cpu or cuda"),
        (["tracking.uri=./mlruns"], "tracking.uri is './mlruns', but this store cannot be used"),
        (["hydra.job.chdir=true"], "hydra.job.chdir is 'true', but it must be false: relative paths"),
        (["-m", "seed=1,2", "hydra.job.chdir=true"], "hydra.job.chdir is 'true', but it must be false: relative paths"),
        (["-m", "obs=cluster,foo"], "obs is 'foo', but it must be action_reward, cluster"),
        (["obs=cluster", "-m", "agent=foo"], "agent is 'foo', but it must be "),
        (["-m", "seed=1,2", "tracking=null"], "Config group override must be a string or a list. Got NoneType"),
        (["-m", "seed=1,2", "tracking.uri=./mlruns"], "tracking.uri is './mlruns', but this store cannot be used"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_run_answers_a_mistake_in_one_line_and_leaves_nothing(answer, tmp_path, arguments, line):
    few_phantoms = [] if "data=nifti" in arguments else FEW_VOLUMES
    code, printed = answer(*arguments, *few_phantoms)
    assert code == 2
    assert printed.startswith(f"error: {line}")
    assert len(printed.splitlines()) == 1
    assert {file.name for file in tmp_path.iterdir()} <= {"mlruns.db", "mlruns.db.lock"}


@pytest.mark.parametrize(
    "arguments", [["hydra.run.dir=results"], ["-m", "hydra.sweep.dir=results"], ["hydra.run.dir=."]]
)
def test_run_that_fails_touches_no_file_of_others(answer, tmp_path, arguments):
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "precious.txt").write_text("x")
    code, _ = answer(*arguments, "seed=-1")
    assert code != 0
    assert {file.name for file in (tmp_path / "results").iterdir()} == {"precious.txt"}


@pytest.mark.parametrize("name", ["last.pt", "config.yaml", "policy/notes.txt"])
def test_run_is_refused_a_folder_where_it_would_overwrite_files_of_others(answer, tmp_path, name):
    for precious in (name, "tracking/notes.txt"):
        (tmp_path / "mine" / precious).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "mine" / precious).write_text("precious")
    code, printed = answer("hydra.run.dir=mine", *SMALL)
    assert code == 2
    assert f"mine: holds {Path(name).parts[0]}, which no run made" in printed
    assert len(printed.splitlines()) == 1
    there = {file.relative_to(tmp_path).as_posix() for file in tmp_path.rglob("*") if file.is_file()}
    assert there == {f"mine/{name}", "mine/tracking/notes.txt"}


def test_folder_of_an_earlier_run_can_be_used_again_and_files_of_others_are_not_uploaded(answer, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.json").write_text("precious")
    assert answer("hydra.run.dir=mine", *SMALL)[0] == 0
    assert answer("hydra.run.dir=mine", "agent=random", *FEW)[0] == 0
    client, (later, earlier) = runs_in(tmp_path)
    kept = {run.info.run_id: {file.path for file in client.list_artifacts(run.info.run_id)} for run in (later, earlier)}
    assert "best.pt" in kept[earlier.info.run_id]
    assert not kept[later.info.run_id] & {"best.pt", "last.pt", "learning_curve.png"}
    assert not any("notes.json" in names for names in kept.values())
    assert (tmp_path / "mine" / "notes.json").read_text() == "precious"


def test_run_shows_what_is_wrong_with_a_volume(answer, tmp_path, write_labelmap, write_manifest):
    path = write_labelmap("wrist.nii.gz")
    path.write_bytes(path.read_bytes()[:-10])
    folder = write_manifest({"wrist.nii.gz": {"rotation": [0, 0], "translation": [0, 5]}})
    code, printed = answer("data=nifti", f"data.path={folder}")
    assert code == 2
    assert printed.startswith(f"error: {path}: the file is truncated: it ends within its compressed voxels")
    assert {file.name for file in tmp_path.iterdir()} == {"wrist.nii.gz", "optimal_actions.json"}


@pytest.mark.full
@pytest.mark.parametrize("multirun", [[], ["-m", "seed=0,1", "hydra.launcher.n_jobs=2"]], ids=["single", "multirun"])
@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGHUP], ids=["Ctrl-C", "closed terminal"])
def test_interrupted_run_is_closed_as_killed(tmp_path, multirun, ending):
    process = start_run(*multirun, *SMALL, "training.env_steps=500000", cwd=tmp_path)
    n_jobs = 2 if multirun else 1

    def n_at_work():
        lines = (tmp_path / "printed").read_text().splitlines()
        # Counted by the prefix of each line, which names its job.
        told = Counter(line.partition("]")[0][:3] for line in lines if "/500000 steps" in line)
        return sum(count >= 2 for count in told.values()) if multirun else min(1, sum(told.values()) // 2)

    wait_until(lambda: n_at_work() >= n_jobs, process=process, log=(tmp_path / "printed").read_text, poll_s=0.5)
    os.killpg(process.pid, ending)
    assert process.wait(HANG_S) == 130
    output = (tmp_path / "printed").read_text()
    # Joblib's own process, which a closed terminal ends, may print after it.
    assert "interrupted" in output.splitlines()
    # If the signal interrupts compiled code, its library may still print where it was; no job has failed.
    assert "failed" not in output
    tracked = runs_in(tmp_path)[1]
    assert {each.info.status for each in tracked} == {"KILLED"}, [each.data.tags.get("failure") for each in tracked]
    assert len(tracked) == n_jobs + bool(multirun)


@pytest.mark.full
@pytest.mark.parametrize(
    ("ending", "line", "of_grid"),
    [
        (signal.SIGKILL, "killed by SIGKILL: out of memory?", ["FAILED", "FAILED", "FINISHED"]),
        (signal.SIGTERM, "interrupted", ["FINISHED", "KILLED", "KILLED"]),
    ],
    ids=["killed", "interrupted"],
)
def test_job_that_is_ended_takes_no_other_with_it(tmp_path, ending, line, of_grid):
    words = ["-m", "seed=0,1", "hydra.launcher.n_jobs=2", *SMALL, "training.env_steps=8000"]
    process = start_run(*words, cwd=tmp_path)

    def are_tracked():
        return all(label in (tmp_path / "printed").read_text() for label in ("[0 seed=0]", "[1 seed=1]"))

    # Both are running, and either may be killed.
    wait_until(are_tracked, process=process, log=(tmp_path / "printed").read_text)
    os.kill(job_process_ids(process.pid)[0], ending)
    assert process.wait(HANG_S) == 1
    output = (tmp_path / "printed").read_text()
    assert output.count(line) == 1
    assert ("run it alone with: python -m armscan.run seed=" in output) is (ending == signal.SIGKILL)
    assert "resume all with: " in output
    assert "Traceback" not in output
    assert sorted(each.info.status for each in runs_in(tmp_path)[1]) == of_grid


@pytest.mark.full
def test_jobs_of_a_killed_launcher_end_and_go_on_in_their_runs(tmp_path):
    words = ["-m", "seed=0,1", "hydra.launcher.n_jobs=2", *SMALL, "training.env_steps=20000"]
    process = start_run(*words, "training.eval_every_env_steps=1000", cwd=tmp_path)

    def checkpoints():
        return list((tmp_path / "multirun").glob("*/*/*/last.pt"))

    wait_until(lambda: len(checkpoints()) == 2, process=process, log=(tmp_path / "printed").read_text)
    jobs = job_process_ids(process.pid)
    os.kill(process.pid, signal.SIGKILL)
    process.wait(HANG_S)
    wait_until(lambda: not any(map(psutil.pid_exists, jobs)))
    (grid,) = [each for each in runs_in(tmp_path)[1] if each.info.run_name.startswith("grid")]
    # As if the job were still in progress.
    with folder_lock(checkpoints()[0].parent):
        again = armscan_run(f"resume={grid.info.run_id}", "--trust", cwd=tmp_path)
    assert again.returncode == 1, again.stderr
    assert "failed: " in again.stderr
    assert again.stderr.count("another process is using this folder") == again.stderr.count("failed: ")
    assert again.stdout.count("resuming ") == 1
    assert len(runs_in(tmp_path)[1]) == 4, "no run is begun anew"


def job_process_ids(launcher_pid):
    """Return the process IDs of a multirun's jobs: children of the launcher's workers, or of itself on one core."""
    listing = subprocess.run(["ps", "-ewwo", "pid=,ppid=,args="], capture_output=True, text=True, check=True).stdout
    # ps prints a program of several lines on one.
    processes = [line.split(maxsplit=2) for line in listing.splitlines()]
    parents = {int(pid): int(parent) for pid, parent, *_ in processes}
    jobs = [int(pid) for pid, _, *program in processes if "run_job(" in " ".join(program)]
    return [pid for pid in jobs if launcher_pid in (parents[pid], parents.get(parents[pid]))]
