"""Cross-validation: the arguments of its grid, and the table over all folds."""

import itertools
import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
from hydra.errors import HydraException

from armscan.config.error_messages import one_line_message
from armscan.errors import InvalidValueError, TrackingError, VolumeError
from armscan.experiment.job import Grid, JobOutcome
from armscan.launch.folds_grid import with_folds
from armscan.launch.folds_table import AGENT_ON_ALL_FOLDS, folds_table
from armscan.launch.grid_plan import print_grid_plan
from armscan.launch.grid_tables import jobs_table, keep_folds_table, keep_tables
from armscan.tracking.tags import DESCRIPTION_TAG
from armscan.training import TEST, Evaluation, MetricEstimates
from armscan.utils.run_files import RESULTS_PAGE
from tests.support.stores import store_in
from tests.training.test_train import episode_of


@pytest.fixture
def folder(write_labelmap, tmp_path):
    """Three volumes of two subjects, and one that is left out."""
    entries = {name: {"subject": subject} for name, subject in (("a.nrrd", "S"), ("b.nrrd", "S"), ("c.nrrd", "T"))}
    entries["d.nrrd"] = {"subject": "U", "exclude": True}
    for name in entries:
        write_labelmap(name)
    (tmp_path / "manifest.json").write_text(json.dumps({"volumes": entries}))
    return tmp_path


def test_folds_make_a_grid_of_one_run_for_each_subject(folder):
    words = ["data=nifti", f"data.path={folder}", "data.folds=leave_one_out"]
    assert with_folds(words) == ["-m", *words, "data.fold=0,1"]
    # With what a grid varies anyway.
    assert with_folds(["-m", *words, "seed=0,1,2"]) == ["-m", *words, "seed=0,1,2", "data.fold=0,1"]
    assert with_folds([*words, "agent=sac,ppo"]) == ["-m", *words, "agent=sac,ppo", "data.fold=0,1"]


def test_plan_lists_the_folds_beside_what_else_a_grid_varies(folder, capsys):
    print_grid_plan(["experiment=few_wrists", f"data.path={folder}", "seed=3,4", "--plan"])
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "a grid of 4 jobs"
    assert [line.split()[1:] for line in printed[1:]] == [
        [f"seed={seed}", f"data.fold={fold}"] for seed in (3, 4) for fold in (0, 1)
    ]


def test_plan_knows_which_choices_a_pattern_has(capsys):
    print_grid_plan(["-m", "agent=glob(ran*)", "seed=0,1", "training.env_steps=2e4", "--plan"])
    assert [line.split()[1:] for line in capsys.readouterr().out.splitlines()[1:]] == [
        ["agent=random", "seed=0"],
        ["agent=random", "seed=1"],
    ]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["seed=1", "--plan"], "--plan is given, but this is a single run: it shows the jobs of a grid"),
        (["-m", "agent=sac,nothing", "--plan"], "agent is 'nothing', but it must be"),
        (["seed=0,1", "--plan"], "'seed=0,1' gives several values: armscan run -m tries each of them"),
    ],
)
def test_plan_of_what_is_no_grid_or_cannot_run_is_answered_in_one_line(words, line):
    with pytest.raises((InvalidValueError, HydraException)) as raised:
        print_grid_plan(words)
    assert line in one_line_message(raised.value)


@pytest.mark.parametrize("prefix", ["", "++"])
def test_experiment_may_ask_for_folds(folder, prefix):
    words = ["experiment=few_wrists", f"data.path={folder}"]
    assert with_folds([words[0], words[1], f"{prefix}data.folds=2"])[-1] == "data.fold=0,1"
    assert with_folds(words) == ["-m", *words, "data.fold=0,1"]
    assert with_folds([*words, "data.folds=null"]) == [*words, "data.folds=null"]


def test_several_experiments_may_ask_for_the_same_folds(folder):
    words = ["data=mixed", f"data.path={folder}"]
    several = ["experiment=few_wrists,few_wrists_sac", *words]
    assert with_folds(["-m", *several]) == ["-m", *several, "data.fold=0,1"]
    with pytest.raises(InvalidValueError, match=r"data.folds differs between the jobs .* \(None or leave_one_out\)"):
        with_folds(["-m", "experiment=few_wrists,best_y", *words])


def test_plan_refuses_what_hydra_cannot_compose_without_the_varied_keys(folder):
    with pytest.raises(
        InvalidValueError, match=r"needs data=nifti .*; Hydra first composes the grid without experiment,"
    ):
        print_grid_plan(["-m", "experiment=few_wrists,few_wrists_sac", f"data.path={folder}", "--plan"])


@pytest.mark.parametrize(
    "words",
    [
        ["seed=1"],
        ["experiment=best_y"],
        ["data=nifti", "data.folds=2", "data.fold=1"],
        ["-m", "data=nifti", "data.path=x", "data.folds=2", "data.fold=0,1"],
        # Options of Hydra that only show something, and words that Hydra refuses.
        ["data=nifti", "data.folds=2", "--cfg=job"],
        ["data=phantom", "data.folds=2"],
        ["experiment=nothing"],
    ],
)
def test_other_words_stay_as_they_are(words):
    assert with_folds(words) == words


def test_impossible_folds_are_refused_before_anything_runs(folder):
    with pytest.raises(InvalidValueError, match=r"data.folds is 3, but it must be .* at most 2"):
        with_folds(["data=nifti", f"data.path={folder}", "data.folds=3"])
    with pytest.raises(VolumeError, match="nowhere"):
        with_folds(["data=nifti", "data.path=nowhere", "data.folds=2"])
    for n_volumes in ("0", "4", "-1", "1.5", "abc", "[1]"):
        with pytest.raises(InvalidValueError, match=r"data\.n_volumes is .* at least 1 and at most 3"):
            with_folds(["data=mixed", f"data.path={folder}", "data.folds=2", f"data.n_volumes={n_volumes}"])


def test_several_numbers_of_folds_are_refused(folder):
    with pytest.raises(InvalidValueError, match=r"data\.folds has several values"):
        with_folds(["-m", "data=nifti", f"data.path={folder}", "data.folds=2,3"])


def left_by_a_run(folder, volume, distances_mm):
    episodes = [episode_of(volume=volume, seed=i, distance_mm=mm) for i, mm in enumerate(distances_mm)]
    folder.mkdir()
    evaluation = Evaluation(tuple(episodes)).to_dict()
    (folder / "evaluation.json").write_text(json.dumps({TEST: evaluation, "training volumes": evaluation}))
    (folder / "baselines.json").write_text(json.dumps({"random": Evaluation(tuple(episodes[:1])).to_dict()}))
    return folder


def table_of(runs):
    """Return the table of runs, each with the words that differ."""
    return folds_table([(folder, varied if isinstance(varied, list) else varied.split()) for folder, varied in runs])


def test_table_puts_the_wrists_of_all_folds_together(tmp_path):
    runs = [
        (left_by_a_run(tmp_path / f"{fold}-{seed}", f"wrist{fold}", distances), f"data.fold={fold} seed={seed}")
        for seed, of_folds in enumerate([([1.0, 2.0], [5.0, 6.0]), ([3.0, 4.0], [7.0, 8.0])])
        for fold, distances in enumerate(of_folds)
    ]
    table = table_of(runs)
    figures = table.results[AGENT_ON_ALL_FOLDS]
    assert (figures.n_seeds, figures.n_volumes, figures.n_episodes) == (2, 2, 8)
    assert figures.estimate("median_distance_mm").value == 4.5
    # Whatever the seed of a training, random planes are the same: they count once.
    assert (table.results["random, all folds"].n_seeds, table.results["random, all folds"].n_episodes) == (1, 2)
    # The interval resamples wrists: it is the same as for the same episodes in one evaluation.
    first = [json.loads((folder / "evaluation.json").read_text())[TEST] for folder, _ in runs[:2]]
    alone = Evaluation(tuple(each for one in first for each in Evaluation.of_dict(one).episodes))
    expected = MetricEstimates.of(alone).estimate("median_distance_mm")
    found = table_of([(path, varied.split()[0]) for path, varied in runs[:2]]).results[AGENT_ON_ALL_FOLDS]
    assert found.estimate("median_distance_mm") == pytest.approx(expected)


def test_folds_that_a_seed_lacks_are_left_out_of_the_table(tmp_path):
    runs = [
        (left_by_a_run(tmp_path / f"{fold}-{seed}", f"wrist{fold}", [1.0]), f"data.fold={fold} seed={seed}")
        for fold, seed in ((0, 0), (0, 1), (1, 1))
    ]
    results = table_of(runs).results
    assert (results[AGENT_ON_ALL_FOLDS].n_seeds, results[AGENT_ON_ALL_FOLDS].n_volumes) == (2, 1)
    assert (results["random, all folds"].n_volumes, results["random, all folds"].n_episodes) == (1, 1)
    assert table_of([runs[0], runs[2]]) is None
    # A grid of three folds that was interrupted.
    table = folds_table([(runs[0][0], ["data.fold=0"])], n_folds=3)
    assert list(table.results) == ["agent, 1 of 3 folds", "random, 1 of 3 folds"]
    assert "all folds" not in table.headline


def test_every_wrist_counts_alike_however_many_a_fold_has(tmp_path):
    near, far = [1.0] * 6, [9.0] * 2
    runs = [
        (left_by_a_run(tmp_path / name, name, each), f"data.fold={name}") for name, each in (("a", near), ("b", far))
    ]
    figures = table_of(runs).results[AGENT_ON_ALL_FOLDS]
    assert (figures.n_volumes, figures.n_episodes) == (2, 4)
    assert figures.estimate("on_plane_5mm_10deg").value == 0.5


def test_page_and_description_of_all_folds_say_what_is_missing(tmp_path, database):
    store, experiment_id = store_in(tmp_path, "a")
    run_id = store.create_run(experiment_id, name="grid", tags={}).info.run_id
    table = table_of([(left_by_a_run(tmp_path / "a", "wrist", [1.0]), "data.fold=0")])
    jobs = jobs_table({"1": JobOutcome("", "data.fold=1", failure="out of memory")}, {}, have_same_task=False)
    keep_folds_table(table, jobs, tmp_path, store, run_id, ["1 of 2 jobs are missing"])
    shown = (tmp_path / RESULTS_PAGE).read_text()
    assert "<p>1 of 2 jobs are missing</p>" in shown
    of_jobs = shown.partition("<h2>Jobs</h2>")[2]
    assert "data.fold=1" in of_jobs
    assert "failed" in of_jobs
    assert store.get_run(run_id).data.tags[DESCRIPTION_TAG].startswith("1 of 2 jobs are missing\n\n")


@pytest.mark.parametrize(("key", "values"), [("agent", ("sac", "ppo")), ("projection", ("y", "zy"))])
def test_folds_of_different_tasks_have_no_best(tmp_path, database, capsys, key, values):
    store, experiment_id = store_in(tmp_path, "a")
    run_id = store.create_run(experiment_id, name="grid", tags={}).info.run_id
    outcomes, runs = {}, []
    for number, (value, fold) in enumerate(itertools.product(values, ("0", "1"))):
        folder = left_by_a_run(tmp_path / str(number), f"wrist{fold}", [1.0])
        words = f"data.fold={fold} {key}={value}"
        outcomes[str(number)] = JobOutcome(words, words, metrics={})
        of_run = {"tags": {"job": str(number), "folder": str(folder)}, "params": {key: value, "data.fold": fold}}
        runs.append(SimpleNamespace(data=SimpleNamespace(**of_run)))
    overrides = ["data.fold=0,1", f"{key}={','.join(values)}"]
    grid = Grid(run_id=run_id, tracking={}, overrides=overrides, shared=[])
    keep_tables(jobs_table(outcomes, {}, have_same_task=False), tmp_path, grid, outcomes, runs, store)
    said = capsys.readouterr()
    assert said.err == ""
    assert ("best of 2" in said.out) == (key == "agent")
    note = f"the jobs have different tasks ({key}), so the table names none as the best"
    assert (note in " ".join(said.out.split())) == (key != "agent")


@pytest.mark.parametrize("folds", ["3", "leave_one_out"])
def test_grid_of_some_folds_says_how_many_there_are(write_labelmap, tmp_path, database, capsys, folds):
    for name in ("a.nrrd", "b.nrrd", "c.nrrd"):
        write_labelmap(name)
    (tmp_path / "manifest.json").write_text("{}")
    store, experiment_id = store_in(tmp_path, "a")
    run_id = store.create_run(experiment_id, name="grid", tags={}).info.run_id
    params = {"data.folds": folds, "data.path": str(tmp_path)}
    outcomes, runs = {}, []
    for fold in ("0", "1"):
        folder = left_by_a_run(tmp_path / fold, f"wrist{fold}", [1.0])
        outcomes[fold] = JobOutcome(f"data.fold={fold}", f"data.fold={fold}", metrics={})
        of_run = {"tags": {"job": fold, "folder": str(folder)}, "params": params | {"data.fold": fold}}
        runs.append(SimpleNamespace(data=SimpleNamespace(**of_run)))
    grid = Grid(run_id=run_id, tracking={}, overrides=["data.fold=0,1"], shared=[])
    keep_tables(jobs_table(outcomes, {}, have_same_task=True), tmp_path, grid, outcomes, runs, store)
    assert "agent, 2 of 3 folds" in capsys.readouterr().out


def test_damaged_evaluation_of_a_fold_is_an_error_in_one_line(tmp_path):
    folder = left_by_a_run(tmp_path / "0", "wrist", [1.0])
    file = folder / "evaluation.json"
    for contents in (file.read_text()[:100], "{}", "[]", '{"test volumes": 3}'):
        file.write_text(contents)
        with pytest.raises(TrackingError, match=f"the evaluations in {folder} cannot be read: "):
            folds_table([(folder, ["data.fold=0"])])


@pytest.mark.parametrize("key", ["seed", "data.fold"])
def test_page_of_an_interrupted_grid_counts_the_jobs_that_were_planned(tmp_path, database, capsys, key):
    store, experiment_id = store_in(tmp_path, "a")
    run_id = store.create_run(experiment_id, name="grid", tags={}).info.run_id
    outcomes = {"0": JobOutcome("", f"{key}=0", metrics={}), "1": JobOutcome("", f"{key}=1", failure="interrupted")}
    grid = Grid(run_id=run_id, tracking={}, overrides=[f"{key}=0,1,2,3"], shared=[])
    keep_tables(jobs_table(outcomes, {}, have_same_task=False), tmp_path, grid, outcomes, [], store)
    assert capsys.readouterr() == ("note: of 4 jobs, 3 without a result\n", "")
    page = (tmp_path / RESULTS_PAGE).read_text()
    assert "<h1>Grid of 4 jobs</h1>" in page
    assert "<p>of 4 jobs, 3 without a result</p>" in page
    assert store.get_run(run_id).data.tags[DESCRIPTION_TAG].startswith("of 4 jobs, 3 without a result\n\n")


@pytest.mark.parametrize(
    ("varied", "n_folds", "tracked"),
    [
        (["data.fold=0"], 1, {"test_volumes", "random"}),
        # Their figures are in the page alone.
        (["data.fold=0"], 2, set()),
        (["data.fold=0 agent=sac", "data.fold=0 agent=ppo"], 1, set()),
    ],
)
def test_grid_has_the_metrics_of_all_folds_alone(tmp_path, database, varied, n_folds, tracked):
    store, experiment_id = store_in(tmp_path, "a")
    run_id = store.create_run(experiment_id, name="grid", tags={}).info.run_id
    runs = [(left_by_a_run(tmp_path / str(i), "wrist", [1.0]), words.split()) for i, words in enumerate(varied)]
    jobs = jobs_table({"0": JobOutcome("", "data.fold=0", metrics={})}, {}, have_same_task=False)
    keep_folds_table(folds_table(runs, n_folds), jobs, tmp_path, store, run_id, [])
    run = store.get_run(run_id)
    assert {key.split("/")[0] for key in run.data.metrics} == tracked
    assert DESCRIPTION_TAG in run.data.tags
    assert [file.path for file in store.list_artifacts(run_id)] == [RESULTS_PAGE]


def test_no_job_is_the_best_of_those_that_are_tested_on_other_wrists():
    outcomes = {
        str(fold): JobOutcome("", f"data.fold={fold}", metrics={TEST: {"on_plane_5mm_10deg": rate}})
        for fold, rate in enumerate((0.3, 0.9))
    }
    assert jobs_table(outcomes, {}, have_same_task=False).headline == ""
    others = {number: replace(each, varied=f"agent={number}") for number, each in outcomes.items()}
    assert (
        "best of 2, chosen on these volumes: 1 (agent=1), 90.0%" in jobs_table(others, {}, have_same_task=True).headline
    )


def test_table_keeps_kinds_of_runs_apart_and_a_grid_without_folds_has_none(tmp_path):
    runs = [
        (
            left_by_a_run(tmp_path / f"{fold}{agent[:3]}", f"wrist{fold}", [1.0]),
            [f"agent={agent}", f"data.fold={fold}"],
        )
        # A value may contain blanks.
        for agent in ("sac", "{note: a b=c, gamma: 0}")
        for fold in range(2)
    ]
    titles = ["agent, all folds, agent=sac", "agent, all folds, agent={note: a b=c, gamma: 0}"]
    assert [title for title in table_of(runs).results if title.startswith("agent")] == titles
    assert table_of([(path, "seed=1") for path, _ in runs]) is None
    assert table_of([]) is None
