"""The command that evaluates, as a person types it, on real tracked runs."""

import contextlib
import json
import shutil
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import SimpleITK
import yaml
from mlflow import MlflowClient
from omegaconf import OmegaConf

from armscan.config.compose import compose
from armscan.experiment.build import build_experiment
from armscan.tracking import DOMAIN_TAG, TrackedRun, open_store
from armscan.training import TrainingDomain, load_checkpoint, save_checkpoint
from armscan.utils.files import SHA256_TAGS, sha256
from armscan.volumes.resampling import resample
from tests.test_run import SMALL, armscan_run, runs_in

FEW = ["data.n_training=1", "data.n_validation=1", "data.n_test=1", "env.max_steps=4"]
IMAGES = ["network.images.filters=[2,2,2]", "network.images.vector_sizes=[4]", "network.images.head_sizes=[4]"]
IMAGES += ["agent.buffer_size=500", "agent.num_envs=1", "agent.learning_starts=1"]
GUESSER = {"_target_": "tests.cli.test_evaluate.Guesser"}


class Guesser:
    """A baseline: an algorithm and its agent, which draws planes."""

    def agent(self, setup):
        self._n_free = len(setup.action_names)
        return self

    def begin(self, *, seed, bounds):
        self._rng = np.random.default_rng(seed)

    def act(self, observation, reward):
        return self._rng.uniform(-1, 1, self._n_free)


def tracked(folder, *overrides, agent=None, kept=("config.yaml", "volumes.json", "best.pt"), has_tag=True, few=FEW):
    """Tracks a run of an agent that has learned nothing, started in this folder; returns its id."""
    config = compose([*few, *overrides])
    OmegaConf.resolve(config)
    if agent:
        config.agent = agent
    with contextlib.chdir(folder):
        experiment = build_experiment(config)
    client, experiment_id = open_store(
        f"sqlite:///{folder}/mlruns.db", experiment="armscan", artifacts=str(folder / "artifacts"), wait_s=60.0
    )
    domain = TrainingDomain.of(experiment.env_factory.make_env(experiment.split.training))
    (folder / "config.yaml").write_text(yaml.safe_dump(OmegaConf.to_container(config)))
    (folder / "volumes.json").write_text(json.dumps(experiment.split.fingerprints()))
    tags = {SHA256_TAGS[name]: sha256((folder / name).read_bytes()) for name in SHA256_TAGS if name in kept}
    tags |= {"volumes.training": " ".join(experiment.split.training), "working_folder": str(folder)}
    tags |= {DOMAIN_TAG: domain.to_json()} if has_tag else {}
    with TrackedRun.start(client, experiment_id, name="tiny", config={}, tags=tags, folder=folder) as run:
        if agent is None:
            facts = {"n_env_steps": 7, "run_id": run.run_id}
            save_checkpoint(folder / "best.pt", experiment.agent.weights(), facts)
        run.log_files(*(folder / name for name in kept if (folder / name).exists()))
    return run.run_id


@pytest.fixture(autouse=True)
def tracking_database(database):
    """Spares each test the making of MLflow's tables."""


@pytest.fixture
def answer(armscan, monkeypatch):
    """Runs `armscan evaluate` in this process; returns its exit code and what it printed."""
    monkeypatch.setenv("COLUMNS", "200")
    return partial(armscan, "evaluate")


@pytest.fixture
def coarse_folder(tmp_path, phantom):
    """Phantoms of other sizes and spacing, with a manifest that splits them."""
    folder = tmp_path / "coarse"
    folder.mkdir()
    entries = {}
    for name, spacing in (("a.nii.gz", (0.4, 0.5, 0.5)), ("b.nii.gz", (0.45, 0.55, 0.5))):
        volume = resample(phantom, spacing)
        image = SimpleITK.GetImageFromArray(np.ascontiguousarray(np.transpose(volume.labels)), isVector=False)
        image.SetSpacing(volume.spacing)
        SimpleITK.WriteImage(image, str(folder / name))
        plane = volume.optimal_action
        entries[name] = {"rotation": list(plane.rotation), "translation": list(plane.translation)}
    splits = {"train": ["a.nii.gz"], "test": ["b.nii.gz"]}
    (folder / "manifest.yaml").write_text(yaml.safe_dump({"volumes": entries, "splits": splits}))
    return folder


def written(folder, pattern="*"):
    (file,) = (folder / "evaluations").glob(f"{pattern}.json")
    return json.loads(file.read_text())


def test_evaluate_makes_nothing_where_artifacts_are_read_only(answer, tmp_path, made_read_only):
    run_id = tracked(tmp_path)
    with made_read_only(tmp_path / "artifacts"):
        code, _, errors = answer(run_id, "--episodes=3")
    assert code == 2
    assert errors.startswith(f"error: the artifacts of runs lie in {tmp_path}/artifacts")
    assert len(runs_in(tmp_path)[1]) == 1
    assert not list(tmp_path.glob("evaluations/*"))


@pytest.mark.slow
def test_evaluate_judges_a_run_as_it_was_trained(tmp_path, data_folder):
    assert armscan_run(*SMALL, cwd=tmp_path).returncode == 0
    client, (run,) = runs_in(tmp_path)
    command = [sys.executable, "-m", "armscan", "evaluate", run.info.run_id[:10]]
    for words in (["--episodes=3"], ["--episodes=4", f"--data={data_folder}", "--success-threshold=0.1"]):
        ended = subprocess.run([*command, *words], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (ended.returncode, ended.stderr) == (0, "")
        assert "on plane,  " in ended.stdout
    children = client.search_runs([run.info.experiment_id], f"tags.mlflow.parentRunId = '{run.info.run_id}'")
    assert len(children) == 2
    assert {file.path for file in client.list_artifacts(run.info.run_id)} >= {"best.pt", "config.yaml"}


def test_evaluate_gives_figures_with_intervals_as_table_json_and_metrics(answer, tmp_path):
    run_id = tracked(tmp_path)
    code, printed, errors = answer(run_id, "--episodes=5", "--max-steps=3", "--success-threshold=0.04")
    assert (code, errors) == (0, "")
    for word in (
        "on plane,",
        "5 mm 10°",
        "random",
        "sweep 5 mm",
        "steps, 95th percentile",
        "Dice artery,",
        "phantom-2000000",
        "not started solved",
    ):
        assert word in printed
    contents = written(tmp_path)
    assert contents["of"] == run_id
    assert contents["changes"] == {"max_steps": 3, "success_threshold": 0.04}
    assert list(contents["splits"]) == ["training volumes", "validation volumes", "test volumes"]
    assert max(episode["n_steps"] for episode in contents["episodes"]["test volumes"]) <= 3
    assert list(contents["volumes"]["test volumes"]) == ["phantom-2000000"]
    client = MlflowClient(f"sqlite:///{tmp_path}/mlruns.db")
    child = client.get_run(contents["tracked_as"])
    assert child.data.tags["mlflow.parentRunId"] == child.data.tags["evaluation.of"] == run_id
    for figure in ("success_rate", "p95_steps", "mean_best_reward", "median_distance_deg", "mean_dice_bones"):
        numbers = contents["splits"]["test volumes"]["figures"][figure]
        assert numbers["low"] <= numbers["value"] <= numbers["high"]
        for group in ("test_volumes", "volume/phantom-2000000"):
            assert child.data.metrics[f"{group}/{figure}"] == pytest.approx(numbers["value"])
            assert child.data.metrics[f"{group}/{figure}_low"] == pytest.approx(numbers["low"])
    assert child.data.params["env.max_steps"] == "3"
    assert {file.path[-5:] for file in client.list_artifacts(child.info.run_id)} == {".json", ".html"}
    assert 0.0 <= child.data.metrics["random/test_volumes/on_plane_5mm_10deg"] <= 1.0
    # The run itself stays as it was, and an evaluation is nothing to evaluate.
    assert not client.get_run(run_id).data.metrics
    code, _, errors = answer(contents["tracked_as"])
    assert (code, errors) == (2, f"error: run is {contents['tracked_as']!r}, but that is an evaluation, of {run_id}")


def test_evaluate_gives_the_same_figures_again(answer, tmp_path):
    run_id = tracked(tmp_path, "projection=zy")
    figures = []
    # The second replaces the first.
    for _ in range(2):
        assert answer(run_id, "--episodes=4", "--seed=3", "--out=a.json")[0] == 0
        contents = json.loads((tmp_path / "a.json").read_text())["splits"]["test volumes"]["figures"]
        figures.append({key: value for key, value in contents.items() if "seconds" not in key})
    assert figures[0] == figures[1]


def test_agent_is_applied_to_volumes_of_other_sizes_and_spacing(answer, tmp_path, coarse_folder):
    run_id = tracked(tmp_path, "reward=agreement", "env.clustering=metric")
    code, printed, errors = answer(run_id, f"--data={coarse_folder}", "--episodes=3")
    assert (code, errors) == (0, "")
    assert "note: train split: a pixel is 0.4 mm across (trained on 0.27)" in printed
    contents = written(tmp_path)
    assert list(contents["splits"]) == ["train split", "test split", "all volumes"]
    assert contents["splits"]["all volumes"]["episodes"] == 6
    assert contents["notes"]


def test_labelled_planes_that_score_too_little_are_refused_with_what_may_be_the_reason(answer, tmp_path, coarse_folder):
    run_id = tracked(tmp_path)
    manifest = yaml.safe_load((coarse_folder / "manifest.yaml").read_text())
    manifest["volumes"]["b.nii.gz"]["translation"][1] -= 60
    (coarse_folder / "manifest.yaml").write_text(yaml.safe_dump(manifest))
    for word, ending in (
        ("--seed=0", "here a pixel has 0.45 x 0.5 mm: unless the plane is wrong, --clustering metric may see them"),
        ("--clustering=metric", "but it must score above -success_threshold = -0.05"),
    ):
        code, _, errors = answer(run_id, f"--data={coarse_folder}", "--episodes=2", word)
        assert code == 2
        assert errors.startswith("error: b.nii.gz: the labelled optimal plane scores")
        assert errors.endswith(ending)


def test_images_of_another_shape_are_refused_with_the_reason(answer, tmp_path, coarse_folder):
    run_id = tracked(tmp_path, "obs=slice", "obs.shape=null", "env.clustering=metric", *IMAGES)
    code, _, errors = answer(run_id, f"--data={coarse_folder}", "--episodes=2")
    assert code == 2
    assert "the agent was trained on images of" in errors
    assert "it cannot be applied to them" in errors
    assert answer(run_id, "--data=phantom", "--phantoms=1", "--episodes=1")[0] == 0


def test_run_that_has_not_kept_what_it_was_trained_on_is_refused_by_its_network(answer, tmp_path, coarse_folder):
    run_id = tracked(tmp_path, "obs=slice", "obs.shape=null", "env.clustering=metric", *IMAGES, has_tag=False)
    code, _, errors = answer(run_id, f"--data={coarse_folder}", "--episodes=2")
    assert code == 2
    assert "the checkpoint is another agent's or network's" in errors


ON_FILES = {"few": ["data=nifti", "data.path=wrists", "env.max_steps=2"]}


def swapped(manifest):
    """Training and test volumes, exchanged."""
    splits = manifest["splits"]
    return manifest | {"splits": splits | {"train": splits["test"], "test": splits["train"]}}


def test_own_volumes_are_those_of_the_folder_that_the_run_was_started_in(answer, tmp_path, wrists):
    run_id = tracked(tmp_path, "projection=zy", agent=GUESSER, **ON_FILES)
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(wrists, elsewhere / "wrists")
    manifest = yaml.safe_load((wrists / "manifest.yaml").read_text())
    (elsewhere / "wrists" / "manifest.yaml").write_text(yaml.safe_dump(swapped(manifest)))
    words = [run_id, "--trust", "--episodes=2", f"--tracking=sqlite:///{tmp_path}/mlruns.db", "--out=a.json"]
    code, _, errors = answer(*words, cwd=elsewhere)
    assert (code, errors) == (0, "")
    assert list(json.loads((elsewhere / "a.json").read_text())["volumes"]["test volumes"]) == manifest["splits"]["test"]
    wrists.rename(tmp_path / "away")
    code, _, errors = answer(*words, cwd=elsewhere)
    assert code == 2
    assert errors.startswith(
        f"error: the volumes of run {run_id} cannot be read: {wrists}: the folder of volumes does not"
    )
    assert f"it was started in {tmp_path}" in errors


@pytest.mark.parametrize("reward", ["published", "agreement"])
def test_own_volumes_that_have_changed_are_refused_where_they_matter(answer, tmp_path, wrists, reward):
    run_id = tracked(tmp_path, f"reward={reward}", "projection=zy", agent=GUESSER, **ON_FILES)
    manifest = yaml.safe_load((wrists / "manifest.yaml").read_text())
    (wrists / "manifest.yaml").write_text(yaml.safe_dump(swapped(manifest)))
    line = f"the training volumes are not those that run {run_id} was started with: "
    code, _, errors = answer(run_id, "--trust", "--episodes=2")
    assert code == 2
    assert errors.startswith(f"error: {line}")
    code, printed, errors = answer(run_id, "--trust", "--data=wrists", "--episodes=4")
    if reward == "agreement":
        assert code == 2
        assert errors.startswith(
            "error: the reward is fitted to the volumes that the agent was trained on, but they are"
        )
        assert line in errors
    else:
        assert (code, errors) == (0, "")
        known = ", ".join(manifest["splits"]["train"])
        assert f"note: the agent was trained on these volumes: {known}\n" in printed


def test_volumes_of_the_training_are_known_under_other_names_and_others_under_theirs(answer, tmp_path, wrists):
    run_id = tracked(tmp_path, agent=GUESSER, **ON_FILES)
    manifest = yaml.safe_load((wrists / "manifest.yaml").read_text())
    one, _, third, last = manifest["volumes"]
    copies = tmp_path / "copies"
    copies.mkdir()
    # One of the training under another name, and one of the test under that of the validation.
    for name, copy in {one: "copy.nii.gz", last: third}.items():
        shutil.copy(wrists / name, copies / copy)
    entries = {"copy.nii.gz": manifest["volumes"][one], third: manifest["volumes"][last]}
    (copies / "manifest.yaml").write_text(yaml.safe_dump({"volumes": entries}))
    code, printed, errors = answer(run_id, "--trust", "--data=copies", "--episodes=2")
    assert (code, errors) == (0, "")
    assert f"note: the agent was trained on these volumes: copy.nii.gz (there {one})\n" in printed
    assert f"note: the agent's checkpoint was chosen on other volumes of these names: {third}\n" in printed


def test_run_without_fingerprints_is_evaluated_with_a_note(answer, tmp_path):
    run_id = tracked(tmp_path, agent=GUESSER, kept=("config.yaml",))
    code, printed, _ = answer(run_id, "--trust", "--episodes=1")
    assert code == 0
    assert "note: the run has not kept fingerprints of its volumes" in printed
    code, printed, _ = answer(run_id, "--trust", "--data=phantom", "--phantoms=1", "--episodes=1")
    assert code == 0
    assert "fingerprints" not in printed


def test_baselines_are_evaluated_by_their_run_or_by_name(answer, tmp_path, phantom):
    run_id = tracked(tmp_path, "projection=zy", agent=GUESSER)
    assert answer(run_id, "--trust", "--data=phantom", "--phantoms=2", "--episodes=2", "--out=run.json")[0] == 0
    words = [
        "--agent=sac",
        "~agent.network",
        "agent._target_=tests.cli.test_evaluate.GuesserOfAnything",
        "projection=zy",
    ]
    code, _, errors = answer(
        *words, "--data=phantom", "--phantoms=2", "--episodes=2", "--max-steps=50", "--out=agent.json"
    )
    assert (code, errors) == (0, "")
    by_name = json.loads((tmp_path / "agent.json").read_text())
    assert by_name["of"] == "sac"
    tags = MlflowClient(f"sqlite:///{tmp_path}/mlruns.db").get_run(by_name["tracked_as"]).data.tags
    assert "mlflow.parentRunId" not in tags


def test_baseline_takes_a_preset_as_a_run_does_and_an_experiment_of_mlflow(answer, tmp_path):
    words = [
        "--agent=random",
        "experiment=best_full",
        "--data=phantom",
        "--phantoms=1",
        "--episodes=1",
        "--tracking-experiment=x",
    ]
    code, _, errors = answer(*words)
    assert (code, errors) == (0, "")
    client = MlflowClient(f"sqlite:///{tmp_path}/mlruns.db")
    (run,) = client.search_runs([client.get_experiment_by_name("x").experiment_id])
    assert run.data.params["projection"] == "full"
    assert run.data.params["agent._target_"] == "armscan.agents.Random"


def test_evaluate_of_a_multirun_asks_for_one_of_its_jobs(answer, tmp_path):
    job_id = tracked(tmp_path)
    client = MlflowClient(f"sqlite:///{tmp_path}/mlruns.db")
    parent = client.create_run(client.get_run(job_id).info.experiment_id, run_name="multirun")
    client.set_tag(job_id, "mlflow.parentRunId", parent.info.run_id)
    _, _, errors = answer(parent.info.run_id)
    assert errors == f"error: run {parent.info.run_id} is the parent of a multirun: give one of its jobs, {job_id}"


class GuesserOfAnything(Guesser):
    """The same, whatever else its configuration says."""

    def __init__(self, **_):
        pass


def test_evaluate_answers_mistakes_in_one_line(answer, tmp_path, data_folder):
    run_id = tracked(tmp_path)
    (tmp_path / "a.json").mkdir()
    words_and_lines = [
        ([], "give one RUN, or --agent NAME"),
        ([run_id, run_id], "give one RUN, or --agent NAME"),
        ([run_id, "--agent=sac", *FEW], f"'{run_id}' cannot be read"),
        ([run_id, "projection=zy"], f"'{run_id} projection=zy' configures an agent: give --agent NAME with it, or RUN"),
        ([run_id, "--projection=zy"], "No such option '--projection'."),
        (["--agent=random", "agent=sac"], "agent is for armscan run, and not read here: give --agent NAME"),
        (["xyz"], "the run is 'xyz', but it must be an id as MLflow shows it"),
        (["ffffffff"], "the run is 'ffffffff', but no run of sqlite:///"),
        ([run_id, "--tracking=sqlite:///no.db"], "tracking.uri is 'sqlite:///no.db', but there is no "),
        ([run_id, "--data=/nowhere"], "--data is '/nowhere', but there is no such folder: it must be "),
        (
            ["--agent=random", "--data=phantoms"],
            "--data is 'phantoms', but there is no such folder: it must be a folder of ",
        ),
        (
            ["--agent=random", f"--data={data_folder}", "data.n_test=1"],
            "there is no key 'n_test' in data, but only path, validation, test or split_seed",
        ),
        ([run_id, "--episodes=0"], "Invalid value for '--episodes': 0 is not in the range x>=1."),
        ([run_id, f"--data={data_folder}", "--episodes=3"], "episodes, of which each of 4 volumes is to have one"),
        ([run_id, "--seed=-1"], "Invalid value for '--seed': -1 is not in the range 0<=x<=2147483647."),
        ([run_id, "--phantoms=3"], "--phantoms is 3, but it is for --data phantom"),
        ([run_id, "experiment=x"], f"'{run_id} experiment=x' configures an agent: give --agent NAME with it"),
        (
            ["--agent=random", "experiment=best_zy", "--data=phantom"],
            "Error in call to target 'armscan.agents.baselines.Random': TypeError(",
        ),
        ([run_id, "--tracking-experiment=x"], "--tracking-experiment is for --agent without --video"),
        (["--agent=random", "experiment=x"], "experiment is 'x', but it must be best_full, "),
        (
            ["--agent=random", "tracking.experiment=x"],
            "tracking.experiment is for armscan run, and not read here: give --tracking-experiment NAME",
        ),
        (
            ["--agent=random", "+tracking.uri=x"],
            "tracking.uri is for armscan run, and not read here: give --tracking URI",
        ),
        (["--agent=random", "tracking.artifacts=x"], "tracking.artifacts is for armscan run, and not read here"),
        (
            ["--agent=random", "evaluation.episodes=5", "--episodes=2"],
            "evaluation.episodes is for armscan run, and not",
        ),
        (
            ["--agent=random", "env.success_threshold=0.01", "--success-threshold=0.5"],
            "--success-threshold and env.success_threshold are both given, but they are one value",
        ),
        (["--agent=random", "data.path=a", f"--data={data_folder}"], "--data and data.path are both given"),
        (
            [run_id, "--success-threshold=7"],
            "Invalid value for '--success-threshold': 7.0 is not in the range 0<x<=1.",
        ),
        ([run_id, "--device=tpu"], "Invalid value for '--device': 'tpu' is not one of 'auto', 'cpu', 'cuda'."),
        ([run_id, "--out=/dev/null/x.json"], "--out is '/dev/null/x.json', but no file can be written there"),
        (
            [run_id, "--episodes=1", "--out=/proc/x.json"],
            "--out is '/proc/x.json', but no file can be written there: ",
        ),
        (
            [run_id, "--episodes=1", "--out=a.json"],
            "--out is 'a.json', but no file can be written there: Is a directory",
        ),
        *(
            ([run_id, "--episodes=1", f"--out={name}"], f"--out is '{name}', but it must be a file whose name ends")
            for name in (".", "config.yaml", "new/figures.txt")
        ),
        (
            [run_id, "--episodes=1", "--out=volumes.json"],
            "--out is 'volumes.json', but that file is no evaluation, and",
        ),
        (["--agent=nobody"], "agent is 'nobody', but it must be "),
        (["--agent=sac", *FEW], "sac has to be trained first: give the RUN that has trained one"),
        (["--agent=sac", "projection=q", *FEW], "projection is 'q', but it must be x, y"),
        (["--agent=sac", "nonsense"], "'nonsense' cannot be read"),
    ]
    for words, line in words_and_lines:
        code, _, errors = answer(*words)
        assert code == 2, words
        assert errors.startswith(f"error: {line}"), (words, errors)
        assert len(errors.splitlines()) == 1, errors
    assert not (tmp_path / "evaluations").exists() or not list((tmp_path / "evaluations").iterdir())
    assert len(runs_in(tmp_path)[1]) == 1


def test_runs_that_have_kept_too_little_are_refused_with_what_to_do(answer, tmp_path):
    run_id = tracked(tmp_path, kept=())
    assert answer(run_id)[2].startswith(f"error: run {run_id} has no config.yaml among its artifacts, as each")
    run_id = tracked(tmp_path, kept=("config.yaml", "volumes.json"))
    assert answer(run_id)[2] == (f"error: run {run_id} has kept no checkpoint, so that there is nothing to evaluate")
    client = MlflowClient(f"sqlite:///{tmp_path}/mlruns.db")
    for status, ended in (("KILLED", "ended before its time (KILLED)"), ("RUNNING", "is still running, or was killed")):
        client.update_run(run_id, status=status)
        assert answer(run_id)[2] == (
            f"error: run {run_id} {ended}, and a run keeps its checkpoint in the store at its end: go on with it by "
            f"python -m armscan.run resume={run_id}"
        )


def with_nan(weights, facts):
    name = next(iter(weights))
    return weights | {name: weights[name] * float("nan")}, facts


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            lambda weights, facts: (weights, facts | {"run_id": "5f"}),
            "best.pt: is a checkpoint of run '5f', but this is",
        ),
        (
            lambda weights, facts: (weights, facts | {"reports": "[]"}),
            "best.pt: holds all of a training, as last.pt does",
        ),
        (lambda weights, facts: ({"other": 1}, facts), "the checkpoint is another agent's or network's"),
        (lambda weights, facts: ([1], facts), "best.pt: is no checkpoint: it holds something else"),
        (with_nan, "best.pt: holds weights that are not finite, in "),
    ],
)
def test_checkpoints_that_are_none_of_the_run_are_refused_before_anything_is_tracked(answer, tmp_path, change, line):
    run_id = tracked(tmp_path)
    save_checkpoint(tmp_path / "best.pt", *change(*load_checkpoint(tmp_path / "best.pt")))
    client, runs = runs_in(tmp_path)
    client.log_artifact(run_id, str(tmp_path / "best.pt"))
    code, _, errors = answer(run_id)
    assert code == 2
    assert errors.startswith(f"error: run {run_id}: {line}")
    assert len(errors) < 350
    assert len(runs_in(tmp_path)[1]) == len(runs)


@pytest.mark.parametrize("name", ["config.yaml", "volumes.json", "best.pt"])
def test_artifacts_that_were_changed_are_refused(answer, tmp_path, name):
    run_id = tracked(tmp_path)
    contents = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(contents.replace(b"0", b"1"))
    client = MlflowClient(f"sqlite:///{tmp_path}/mlruns.db")
    client.log_artifact(run_id, str(tmp_path / name))
    what = "best.pt: is damaged" if name == "best.pt" else f"its {name} is not the one that it was started with"
    assert answer(run_id)[2].startswith(f"error: run {run_id}: {what}")


@pytest.mark.parametrize(("text", "what"), [("a: [", "is damaged"), ("3", "is damaged")])
def test_configuration_without_a_sum_must_still_be_one(answer, tmp_path, text, what):
    run_id = tracked(tmp_path, kept=())
    (tmp_path / "config.yaml").write_text(text)
    MlflowClient(f"sqlite:///{tmp_path}/mlruns.db").log_artifact(run_id, str(tmp_path / "config.yaml"))
    assert answer(run_id)[2] == f"error: run {run_id}: its config.yaml {what}"
