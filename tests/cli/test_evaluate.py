"""The arguments of `armscan evaluate`."""

from tests.support.refusals import assert_refused
from tests.support.tracked_runs import FEW, store_of, tracked
from tests.test_run import runs_in


def test_evaluate_answers_mistakes_in_one_line(evaluate, tmp_path, data_folder):
    run_id = tracked(tmp_path)
    (tmp_path / "a.json").mkdir()
    words_and_lines = [
        ([], "give one RUN, or --agent NAME"),
        ([run_id, run_id], "give one RUN, or --agent NAME"),
        ([run_id, "--agent=sac", *FEW], f"'{run_id}' cannot be read"),
        ([run_id, "projection=zy"], f"'{run_id} projection=zy' configures an agent: give --agent NAME with it, or RUN"),
        ([run_id, "--projection=zy"], "No such option '--projection'."),
        (["--agent=random", "seed=5"], "seed cannot be set here: give --seed NUMBER"),
        (["--agent=random", "agent=sac"], "agent cannot be set here: give --agent NAME"),
        (["xyz"], "the run is 'xyz', but it must be an ID as MLflow shows it"),
        (["ffffffff"], "the run is 'ffffffff', but no run of sqlite:///"),
        ([run_id, "--tracking=sqlite:///no.db"], "tracking.uri is 'sqlite:///no.db', but there is no "),
        ([run_id, "--data=/nowhere"], "--data is '/nowhere', but there is no such folder: it must be "),
        (
            ["--agent=random", "--data=phantoms"],
            "--data is 'phantoms', but there is no such folder: it must be a folder of ",
        ),
        (
            ["--agent=random", f"--data={data_folder}", "data.n_test=1"],
            "there is no key 'n_test' in data, but only path, validation, test, split_seed, folds or fold",
        ),
        ([run_id, "--episodes=0"], "Invalid value for '--episodes': 0 is not in the range x>=1."),
        (
            [run_id, f"--data={data_folder}", "--episodes=3"],
            "--episodes is 3, but it must be at least 4: ",
        ),
        ([run_id, "--seed=-1"], "Invalid value for '--seed': -1 is not in the range 0<=x<=2147483647."),
        ([run_id, "--phantoms=3"], "--phantoms is 3, but it requires --data phantom"),
        ([run_id, "experiment=x"], f"'{run_id} experiment=x' configures an agent: give --agent NAME with it"),
        (
            ["--agent=random", "experiment=best_zy", "--data=phantom"],
            "Error in call to target 'armscan.agents.baselines.Random': TypeError(",
        ),
        ([run_id, "--tracking-experiment=x"], "--tracking-experiment is for --agent without --video"),
        (["--agent=[random]"], "'agent=[random]' is not allowed: a run has one agent, agent=NAME"),
        (["--agent=random,exhaustive"], "'agent=random,exhaustive' gives several values"),
        (["--agent=random", "experiment=x"], "experiment is 'x', but it must be best_full, "),
        (
            ["--agent=random", "tracking.experiment=x"],
            "tracking.experiment cannot be set here: give --tracking-experiment NAME",
        ),
        (
            ["--agent=random", "+tracking.uri=x"],
            "tracking.uri cannot be set here: give --tracking URI",
        ),
        (
            ["--agent=random", "tracking.artifacts=x"],
            "tracking.artifacts cannot be set here: see armscan evaluate --help",
        ),
        (
            ["--agent=random", "evaluation.episodes=5", "--episodes=2"],
            "evaluation.episodes cannot be set here: give --episodes NUMBER",
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
            "--out is 'volumes.json', but that file is not an evaluation",
        ),
        (["--agent=nobody"], "agent is 'nobody', but it must be "),
        (["--agent=sac", *FEW], "sac has to be trained first: give the RUN that has trained one"),
        (["--agent=sac", "projection=q", *FEW], "projection is 'q', but it must be x, y"),
        (["--agent=sac", "nonsense"], "'nonsense' cannot be read"),
    ]
    for words, line in words_and_lines:
        assert_refused(evaluate(*words), line)
    assert not list(tmp_path.glob("evaluations/*"))
    assert len(runs_in(tmp_path)[1]) == 1


def test_video_answers_mistakes_in_one_line(evaluate, tmp_path):
    run_id = tracked(tmp_path)
    client = store_of(tmp_path)
    experiment_id = client.get_run(run_id).info.experiment_id
    evaluation = client.create_run(experiment_id, tags={"evaluation.of": run_id}).info.run_id
    (tmp_path / "file").write_text("mine")
    for words, line in (
        ([evaluation], f"run is '{evaluation}', but that is an evaluation, of {run_id}"),
        ([run_id, "--tracking-experiment=x"], "--tracking-experiment is for --agent without --video"),
        ([run_id, "--out=file"], "--out is 'file', but no video can be written there: "),
        ([run_id, "--out=/proc/videos"], "--out is '/proc/videos', but no video can be written there: "),
    ):
        assert_refused(evaluate("--video", *words), line)
    assert not (tmp_path / "videos").exists()
    assert (tmp_path / "file").read_text() == "mine"
