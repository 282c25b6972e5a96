"""A study in its storage: the same one is resumed, another is refused with what differs."""

import importlib
import re
import sys

import optuna
import pytest

from armscan.errors import InvalidValueError, StudyError
from armscan.sweeps.space.space import Space
from armscan.sweeps.storage.attribute_names import SEEDS
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.arguments import SPACE_OVERRIDE, StudyCommand, trial_overrides
from armscan.sweeps.study.components import read_settings
from armscan.sweeps.study.final_eval_storage import open_final_eval
from armscan.sweeps.study.fixed_config import LATER, TRIAL_VALUE, change_notes
from armscan.sweeps.study.settings import FinalEvalSettings, StudySettings
from armscan.sweeps.study.study import best_trials, existing_study, is_reconfigured, make_study

FIXED = {"agent": {"lr": 1e-3, "gamma": 0.9}, "seed": 3, "device": "cpu", "tracking": {"uri": "a"}}


def settings(**changes):
    values = {
        "name": "a",
        "storage": "optuna.journal",
        "folder": "studies/a",
        "artifacts": "optuna.artifacts",
        "task": {"_target_": "armscan.sweeps.tasks.training.TrainingTask"},
        "space": Space.read({"agent.lr": {"low": 1e-4, "high": 1e-2}}),
        "objectives": {"mean_steps": "minimize"},
        "sampler": {"_target_": "optuna.samplers.RandomSampler"},
        "pruner": {"_target_": "optuna.pruners.NopPruner"},
        "n_trials": 5,
        "prune_after_env_steps": 4000,
        "max_failures": 1,
        "max_retries": 1,
        "timeout_hours": None,
        "max_env_steps": None,
        "workers": 1,
        "seed": 0,
        "seeds": (0,),
        "final_eval": FinalEvalSettings(top_k=0, min_seeds=1, mean_seeds=1, test_seeds=1, episodes=3),
        "allow_config_changes": False,
    }
    return StudySettings(**values | changes)


@pytest.mark.parametrize(
    ("changes", "fixed"),
    [
        ({"n_trials": 50, "workers": 2, "timeout_hours": 3.0}, {}),
        ({}, {"seed": 4, "device": "cuda", "tracking": {"uri": "b"}}),
        ({}, {"agent": {"lr": 5.0, "gamma": 0.9}}),
    ],
    ids=["budgets", "where and how it is computed", "what is searched"],
)
def test_study_goes_on_where_what_its_trials_do_is_the_same(storage_uri, changes, fixed):
    study = make_study(open_storage(storage_uri), settings(), FIXED)
    study.tell(study.ask(), 1.0)
    assert len(make_study(open_storage(storage_uri), settings(**changes), FIXED | fixed).trials) == 1


@pytest.mark.parametrize(
    ("changes", "fixed", "line"),
    [
        (
            {},
            {"agent": {"lr": 1e-3, "gamma": 0.5}},
            "with another configuration: agent.gamma was 0.9, is 0.5",
        ),
        ({}, {"stack": 4}, "stack was not there, is 4; accept that with study.allow_config_changes=true"),
        ({"seeds": (0, 1)}, {}, "study.seeds was [0], is [0, 1]"),
        ({"objectives": {"solved": "maximize"}}, {}, "has other objectives: mean_steps was minimize, is not there"),
        (
            {"space": Space.read({"agent.tau": {"low": 0.1, "high": 0.2}})},
            {},
            "another space: agent.lr was 0.0001 to 0.01, is ",
        ),
    ],
    ids=lambda value: "",
)
def test_study_that_has_changed_is_refused_with_what_differs(storage_uri, changes, fixed, line):
    make_study(open_storage(storage_uri), settings(), FIXED)
    with pytest.raises(StudyError) as error:
        make_study(open_storage(storage_uri), settings(**changes), FIXED | fixed)
    assert line in str(error.value)


AGENTS = Space.read({"agent": {"choices": ["sac", "ppo"]}})
PBT = {"sampler": {"_target_": "armscan.sweeps.scheduling.population.PopulationSampler", "population": 4}}
PBT["sampler"]["interval_env_steps"] = 100


def given(**changes):
    """Return the configuration with overrides, or with checksums of the volumes, as the command adds them."""
    return FIXED | {"study": {"overrides": {}, "volumes": {}} | changes}


@pytest.mark.parametrize(
    ("before", "now", "line"),
    [
        (
            ({}, given(volumes={"test": "2 with the checksum a"})),
            ({}, given(volumes={"test": "2 with the checksum b"})),
            "study.volumes.test was 2 with the checksum a, is 2 with the checksum b",
        ),
        (
            ({"space": AGENTS}, given()),
            ({"space": AGENTS}, given(overrides={"agent.gamma": 0.5, "stack": 1, "study.n_trials": 9})),
            "study.overrides was [], is ['agent.gamma=0.5']",
        ),
        (({}, FIXED), (PBT, FIXED), "study.population was None, is [4, 100]"),
    ],
    ids=["other volumes", "override below a searched group", "population"],
)
def test_study_of_what_earlier_versions_did_not_compare_is_refused_if_both_have_it(storage_uri, before, now, line):
    storage = open_storage(storage_uri)
    study = make_study(storage, settings(**before[0]), before[1])
    study.tell(study.ask(), 1.0)
    with pytest.raises(StudyError, match=re.escape(line)):
        make_study(storage, settings(**now[0]), now[1])
    # The volumes are unknown to workers, which keep those of the command.
    accepted = {"allow_config_changes": True}
    make_study(storage, settings(**now[0], **accepted), now[1])
    make_study(storage, settings(**now[0], **accepted), {**now[1], "stack": 4, "study": {}})
    kept = study.user_attrs["fixed_config"]
    assert {key: kept.get(key) for key in ("stack", "study.volumes.test")} == {
        "stack": 4,
        "study.volumes.test": now[1].get("study", {}).get("volumes", {}).get("test"),
    }


@pytest.mark.parametrize("is_population", [False, True])
def test_study_that_was_made_before_they_were_compared_goes_on(storage_uri, is_population):
    storage, asked = open_storage(storage_uri), PBT if is_population else {}
    study = make_study(storage, settings(**asked), FIXED)
    before = {key: value for key, value in study.user_attrs["fixed_config"].items() if not key.startswith(LATER)}
    study.set_user_attr("fixed_config", before)
    study.enqueue_trial({}, user_attrs={"member": 0} if is_population else {})
    study.tell(study.ask(), 1.0)
    now = given(volumes={"test": "2 with the checksum a"})
    assert len(make_study(storage, settings(**asked), now).trials) == 1
    if not is_population:
        # Its trials show that it is none.
        with pytest.raises(StudyError, match=re.escape("study.population was None, is [4, 100]")):
            make_study(storage, settings(**PBT), now)


@pytest.mark.parametrize("is_searched", [False, True])
def test_study_whose_own_code_has_changed_is_refused(storage_uri, tmp_path, monkeypatch, is_searched):
    folder = tmp_path / "here"
    (folder / "conf" / "agent").mkdir(parents=True)
    (folder / "conf" / "agent" / "own.yaml").write_text("_target_: parts_of_a_study.Own\n")
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    fixed = FIXED if is_searched else FIXED | {"agent": {"_target_": "parts_of_a_study.Own"}}
    asked = {"space": Space.read({"agent": {"choices": ["own", "sac"]}})} if is_searched else {}

    def opened(text):
        (folder / "parts_of_a_study.py").write_text(text)
        monkeypatch.delitem(sys.modules, "parts_of_a_study", raising=False)
        importlib.invalidate_caches()
        return make_study(open_storage(storage_uri), settings(**asked), fixed)

    opened("class Own:\n    pass\n").tell(opened("class Own:\n    pass\n").ask(), 1.0)
    with pytest.raises(StudyError, match=r"another configuration: study\.code\.parts_of_a_study was \w+, is \w+;"):
        opened("class Own:\n    scale = 1\n")


def test_study_with_its_objectives_in_another_order_is_refused(storage_uri):
    objectives = {"mean_steps": "minimize", "success_rate": "maximize"}
    make_study(open_storage(storage_uri), settings(objectives=objectives), FIXED)
    swapped = dict(reversed(objectives.items()))
    with pytest.raises(StudyError, match="has its objectives in another order: mean_steps, success_rate"):
        make_study(open_storage(storage_uri), settings(objectives=swapped), FIXED)


def test_study_that_has_changed_goes_on_where_that_is_accepted_from_then_on(storage_uri):
    make_study(open_storage(storage_uri), settings(), FIXED)
    make_study(open_storage(storage_uri), settings(allow_config_changes=True), FIXED | {"stack": 4})
    make_study(open_storage(storage_uri), settings(), FIXED | {"stack": 4})
    with pytest.raises(StudyError, match="stack was 4, is not there"):
        make_study(open_storage(storage_uri), settings(), FIXED)


def test_change_of_a_configuration_is_noted_with_the_trials_that_had_the_earlier_one(storage_uri):
    storage = open_storage(storage_uri)

    def go_on(n_trials, **fixed):
        study = make_study(storage, settings(allow_config_changes=True), FIXED | fixed)
        for _ in range(n_trials):
            study.tell(study.ask(), 1.0)
        return change_notes(study)

    assert go_on(0) == go_on(2, stack=4) == []
    noted = "trials before 2 had another configuration (stack was 4, is 8), so their values do not compare with others"
    assert go_on(0, stack=8) == [noted]
    # Nothing was tried with 8.
    assert go_on(1, stack=4) == []
    assert go_on(0, stack=2) == [noted.replace("before 2", "before 3").replace("is 8", "is 2")]


def test_study_of_an_earlier_version_goes_on_with_the_names_of_this_one(storage_uri):
    storage, lr = open_storage(storage_uri), {"low": 1e-4, "high": 1e-2}
    before = {"env._target_": "armscan.envs.EnvMaker", "agent.random_env_steps": 2000}
    before |= {"study.seeds": [0], "study.task": "armscan.sweeps.training.Training", TRIAL_VALUE: "new episodes"}
    study = optuna.create_study(study_name="a", storage=storage.optuna)
    study.set_user_attr("space", Space.read({"agent.updates_per_env_step": lr}).to_plain())
    study.set_user_attr("objectives", {"mean_steps": "minimize"})
    study.set_user_attr("fixed_config", before)
    trial = study.ask()
    ratio = trial.suggest_float("agent.updates_per_env_step", **lr)
    study.tell(trial, 1.0)
    fixed = {"env": {"_target_": "armscan.envs.EnvFactory"}, "agent": {"learning_starts": 2000}}
    final_eval = FinalEvalSettings(top_k=1, min_seeds=1, mean_seeds=1, test_seeds=1, episodes=3)
    now = settings(space=Space.read({"agent.utd_ratio": lr}), final_eval=final_eval)
    search = make_study(storage, now, fixed)
    control, best = open_final_eval(storage, now, search, None).missing_of_selection()
    assert (control.params, best.params) == ({}, {"agent.utd_ratio": ratio})


def test_changed_configuration_drops_finished_seeds_of_an_interrupted_trial(storage_uri):
    storage = open_storage(storage_uri)
    study = make_study(storage, settings(), FIXED)
    study.tell(study.ask(), 1.0)
    trial = study.ask()
    trial.set_user_attr(SEEDS, {"0": {"mean_steps": 1.0}})
    more = settings(final_eval=FinalEvalSettings(top_k=0, min_seeds=1, mean_seeds=1, test_seeds=1, episodes=7))
    # No trial of the search depends on the episodes of final trainings.
    assert is_reconfigured(study, more, FIXED)
    study = make_study(storage, more, FIXED)
    assert (change_notes(study), study.trials[1].user_attrs[SEEDS]) == ([], {"0": {"mean_steps": 1.0}})
    study = make_study(storage, settings(allow_config_changes=True), FIXED | {"stack": 4})
    assert len(change_notes(study)) == 1
    assert study.trials[1].user_attrs[SEEDS] == {}


def test_value_of_a_study_that_was_begun_before_was_its_best_validation(storage_uri):
    storage = open_storage(storage_uri)
    study = make_study(storage, settings(), FIXED)
    study.tell(study.ask(), 1.0)
    earlier = {key: value for key, value in study.user_attrs["fixed_config"].items() if key != TRIAL_VALUE}
    study.set_user_attr("fixed_config", earlier)
    with pytest.raises(StudyError, match=r"study\.trial_value was best validation, is new episodes; accept that with"):
        make_study(storage, settings(), FIXED)
    (note,) = change_notes(make_study(storage, settings(allow_config_changes=True), FIXED))
    assert "trials before 1 had another configuration (study.trial_value was best validation, is new episodes)" in note


def test_space_is_changed_key_by_key_on_the_command_line():
    words = [
        *("-m", "sweep=sac_y", "study.space.agent.lr.high=0.5", "study.space.agent.gamma=null"),
        *("study.space.agent.utd_ratio.choices=[0.1,0.2]", "+study.space.agent.batch_size.choices=[8, 16]"),
        *("study.space.agent.tau={low: 0.001, high: 0.1}", "study.space.network.choices=[auto,mlp]"),
        *("study.space.network.vector.hidden_sizes.choices=[[8]]", "agent.target_entropy_per_dim=-1"),
        "study.space.network.vector.hidden_sizes.when={network: auto}",
    ]
    overrides = trial_overrides(StudyCommand.read(words).overrides)
    # Of several with the same key, Hydra's launcher passes on the last alone.
    assert sum(SPACE_OVERRIDE.fullmatch(each.lstrip("+")) is not None for each in overrides) == 1
    settings, _, _ = read_settings(overrides)
    assert settings.space == Space.read(
        {
            "agent.lr": {"low": 1e-4, "high": 0.5, "log": True},
            "agent.utd_ratio": {"choices": [0.1, 0.2]},
            "agent.batch_size": {"choices": [8, 16]},
            "agent.tau": {"low": 0.001, "high": 0.1},
            "network": {"choices": ["auto", "mlp"]},
            "network.vector.hidden_sizes": {"choices": [[8]], "when": {"network": "auto"}},
        }
    )


def test_objective_may_be_an_on_plane_rate_as_it_is_configured():
    words = ["sweep=sac_y", "study/pruner=none", "evaluation.on_plane=[[3,5]]"]
    settings, _, _ = read_settings([*words, "study.objectives=[maximize on_plane_3mm_5deg]"])
    assert settings.objectives == {"on_plane_3mm_5deg": "maximize"}
    with pytest.raises(InvalidValueError, match="names 'on_plane_5mm_10deg', but a trial of this"):
        read_settings([*words, "study.objectives=[maximize on_plane_5mm_10deg]"])


def test_steps_are_no_objective_where_every_episode_has_as_many():
    words = ["sweep=sac_y", "study/pruner=none", "env.ends=on_budget"]
    with pytest.raises(InvalidValueError, match="names 'mean_steps', but a trial of this configuration returns only"):
        read_settings(words)
    settings, _, _ = read_settings([*words, "study.objectives=[minimize median_distance_mm]"])
    assert settings.objectives == {"median_distance_mm": "minimize"}


@pytest.mark.parametrize(("given", "n_threads"), [("", 1), ("1,4", 1), ("2", 2), (" 3 , 1", 3)])
def test_threads_of_workers_are_read_as_openmp_reads_them(monkeypatch, given, n_threads):
    monkeypatch.setenv("OMP_NUM_THREADS", given)
    asked = settings(workers=2)
    asked.check_workers(2 * n_threads)
    with pytest.raises(InvalidValueError, match=r"study\.workers is 2"):
        asked.check_workers(2 * n_threads - 1)


@pytest.mark.parametrize("given", ["many", "0", "-1"])
def test_impossible_number_of_threads_is_named_in_one_line(monkeypatch, given):
    monkeypatch.setenv("OMP_NUM_THREADS", given)
    with pytest.raises(InvalidValueError, match=f"OMP_NUM_THREADS is '{given}'"):
        settings().check_workers(8)


def test_study_with_another_space_is_refused_before_it_is_opened_although_changes_are_allowed(storage_uri):
    storage = open_storage(storage_uri)
    make_study(storage, settings(), FIXED)
    other = settings(space=Space.read({"agent.tau": {"low": 0.1, "high": 0.2}}), allow_config_changes=True)
    with pytest.raises(StudyError, match="searches another space"):
        existing_study(storage, other, FIXED)
    study = existing_study(storage, settings(allow_config_changes=True), FIXED | {"stack": 4})
    # Only read here: the change is stored when the study is opened.
    assert "stack" not in study.user_attrs["fixed_config"]


def test_study_with_other_constraints_is_refused_although_changes_are_allowed(storage_uri):
    storage = open_storage(storage_uri)
    make_study(storage, settings(storage=storage_uri), {})
    storage.study("a").ask()
    changed = settings(storage=storage_uri, constraints=["training_s <= 60"], allow_config_changes=True)
    with pytest.raises(
        StudyError, match=r"has other constraints: study\.constraints was \[\], is \['training_s <= 60'\]"
    ):
        make_study(storage, changed, {})


def test_trial_without_a_value_of_every_key_is_never_best():
    space = Space.read(
        {
            "agent.lr": {"low": 1e-4, "high": 0.5},
            "network": {"choices": ["auto", "mlp"]},
            "stack": {"choices": [1], "when": {"network": "mlp"}},
        }
    )
    study = optuna.create_study()
    study.set_user_attr("space", space.to_plain())
    for params in ({}, {"agent.lr": 0.1}, {"agent.lr": 0.1, "network": "auto"}):
        study.enqueue_trial(params)
        trial = study.ask()
        for each in space.parameters:
            if each.name in params:
                trial._suggest(each.name, each.distribution)
        study.tell(trial, float(trial.number))
    assert [trial.number for trial in best_trials(study, 3)] == [2]
