"""Warm starts: trials of studies with the same configuration, otherwise their best settings; and presets."""

import optuna
import pytest
from optuna.trial import TrialState

from armscan.config.defaults import to_plain
from armscan.config.sources import sweeps_folder
from armscan.errors import StudyError
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.scheduling.state import CONTROL, StudyState
from armscan.sweeps.space.space import Space
from armscan.sweeps.storage.attribute_names import TAKEN_FROM
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.arguments import StudyCommand, trial_overrides
from armscan.sweeps.study.components import read_settings
from armscan.sweeps.study.final_eval_storage import open_final_eval
from armscan.sweeps.study.fixed_config import TRIAL_VALUE
from armscan.sweeps.study.settings import FinalEvalSettings
from armscan.sweeps.study.study import best_trials, make_study
from armscan.sweeps.study.warm_start import N_ENQUEUED, InitialTrials, initial_trials, values_of
from tests.sweeps.study.test_study import settings

LR = {"low": 1e-4, "high": 1e-2, "log": True}
STACK = {"choices": [1, 4]}
FIXED = {"agent": {"lr": 1e-3, "gamma": 0.9, "tau": 0.005}, "stack": 1, "projection": "y"}
ZY = FIXED | {"projection": "zy"}


@pytest.fixture
def study_in(tmp_path):
    """Make a study of a space in the storage, with a finished trial for each row of values."""

    def make(name, space, fixed=FIXED, rows=(), **changes):
        asked = settings(name=name, storage=str(tmp_path / "a.journal"), space=Space.read(space), **changes)
        storage = open_storage(asked.storage)
        study = make_study(storage, asked, fixed)
        for params, value in rows:
            study.enqueue_trial(params)
            trial = study.ask()
            asked.space.suggest(trial)
            if value is None:
                study.tell(trial, state=TrialState.PRUNED)
            else:
                study.tell(trial, value)
        return asked, storage, study

    return make


def begin(made, fixed=FIXED):
    """Add the initial trials of a study; return their messages."""
    asked, storage, study = made
    initial = initial_trials(asked, [], fixed, study)
    for each in initial:
        assert each.add(storage, study)
    return [each.message for each in initial]


def test_text_that_looks_like_a_list_is_a_text(study_in):
    fixed = FIXED | {"data": {"path": "[lab] volumes"}}
    study_in("before", {"agent.lr": LR}, fixed, rows=[({"agent.lr": 1e-3}, 3.0)])
    (message,) = begin(study_in("after", {"agent.lr": LR}, fixed, warm_start=("before",)), fixed)
    assert "1 taken with their values" in message


def test_trials_of_the_same_configuration_are_taken_with_their_values_and_count_nowhere(study_in):
    study_in("before", {"agent.lr": LR}, rows=[({"agent.lr": 1e-3}, 3.0), ({"agent.lr": 2e-3}, None)])
    made = study_in("now", {"agent.lr": LR}, warm_start=["before"])
    assert begin(made) == ["warm start from before, which has 2 finished trials: 2 taken with their values"]
    _, storage, study = made
    assert [trial.user_attrs[TAKEN_FROM] for trial in study.trials] == ["before:0", "before:1"]
    assert [trial.number for trial in best_trials(study, 3)] == [0]
    state = StudyState.of(study.trials)
    assert (len(state.finished), len(state.taken), state.env_steps, state.busy_hours) == (0, 2, 0, 0.0)
    scheduler = TrialScheduler(study, storage, Limits(n_trials=1))
    assert scheduler.claim({"worker": "a"}).number == 2


def test_values_of_earlier_versions_are_not_taken_because_they_were_best_validations(study_in):
    _, _, source = study_in("before", {"agent.lr": LR}, FIXED, rows=[({"agent.lr": 1e-3}, 3.0)])
    stored = {key: value for key, value in source.user_attrs["fixed_config"].items() if key != TRIAL_VALUE}
    source.set_user_attr("fixed_config", stored)
    (message,) = begin(study_in("after", {"agent.lr": LR}, FIXED, warm_start=["before"]))
    assert f"none taken with its value, because its {TRIAL_VALUE} is best validation, and not new episodes" in message


def test_trials_with_fewer_episodes_in_final_trainings_are_taken_with_their_values(study_in):
    study_in("before", {"agent.lr": LR}, FIXED, rows=[({"agent.lr": 1e-3}, 3.0)])
    final_eval = FinalEvalSettings(top_k=0, min_seeds=1, mean_seeds=1, test_seeds=1, episodes=7)
    (message,) = begin(study_in("after", {"agent.lr": LR}, FIXED, warm_start=["before"], final_eval=final_eval))
    assert message.endswith("1 taken with their values")


def test_edited_space_takes_what_fits(study_in):
    rows = [
        ({"agent.lr": 2e-3, "agent.gamma": 0.9}, 1.0),
        ({"agent.lr": 2e-4, "agent.gamma": 0.9}, 2.0),
        ({"agent.lr": 2e-3, "agent.gamma": 0.5}, 3.0),
    ]
    study_in("before", {"agent.lr": LR, "agent.gamma": {"choices": [0.5, 0.9]}}, rows=rows)
    # A narrower range, one key fewer, and a new one, which had a value in the configuration.
    space = {"agent.lr": LR | {"low": 1e-3}, "agent.tau": {"low": 0.001, "high": 0.1}}
    made = study_in("now", space, warm_start=["before"])
    (told,) = begin(made)
    assert "3 finished trials: 1 taken with their values; 2 do not fit, such as: agent.lr=0.0002 is not in" in told
    (trial,) = made[2].trials
    assert (trial.params, trial.value) == ({"agent.lr": 2e-3, "agent.tau": 0.005}, 1.0)


def test_value_of_a_key_that_is_searched_no_more_must_be_the_fixed_one(study_in):
    study_in("before", {"agent.lr": LR, "stack": STACK}, rows=[({"agent.lr": 2e-3, "stack": 4}, 1.0)])
    (told,) = begin(study_in("now", {"agent.lr": LR}, warm_start=["before"]))
    assert told.endswith("0 taken with their values; 1 do not fit, such as: stack=4, which this study does not try")


def test_values_from_before_a_change_of_the_configuration_are_not_taken(study_in):
    study_in("before", {"agent.lr": LR}, ZY, rows=[({"agent.lr": 1e-3}, 3.0)])
    study_in("before", {"agent.lr": LR}, rows=[({"agent.lr": 2e-3}, 2.0)], allow_config_changes=True)
    made = study_in("now", {"agent.lr": LR}, warm_start=["before"])
    (told,) = begin(made)
    assert told.endswith("1 taken with their values; 1 do not fit, such as: its study had another configuration then")
    assert [trial.values for trial in made[2].trials] == [[2.0]]


@pytest.mark.parametrize(
    ("changes", "fixed", "why"),
    [
        ({}, ZY, "its projection is y, and not zy"),
        ({"seeds": (0, 1)}, FIXED, "its study.seeds is [0], and not [0, 1]"),
        ({"objectives": {"solved": "maximize"}}, FIXED, "its objectives are minimize mean_steps"),
    ],
    ids=["task", "seeds", "objectives"],
)
def test_best_settings_of_another_configuration_are_tried_first_without_their_values(study_in, changes, fixed, why):
    rows = [({"agent.lr": 5e-4 * (20 - each), "stack": 1}, float(each)) for each in range(N_ENQUEUED + 3)]
    study_in("before", {"agent.lr": LR, "stack": STACK}, rows=rows)
    # Settings that differ only in keys that this study does not search count as one.
    made = study_in("now", {"agent.lr": LR, "agent.gamma": {"choices": [0.5]}}, fixed, warm_start=["before"], **changes)
    (told,) = begin(made, fixed)
    assert f"none taken with its value, because {why}; the settings of the best {N_ENQUEUED} are tried first" in told
    queued = [trial.system_attrs["fixed_params"] for trial in made[2].trials]
    assert queued == [{"agent.lr": pytest.approx(5e-4 * (20 - each))} for each in range(N_ENQUEUED)]
    assert {trial.state for trial in made[2].trials} == {TrialState.WAITING}


@pytest.mark.parametrize(("pruner", "is_hinted"), [("Median", True), ("Nop", False)])
def test_settings_tried_first_with_the_median_pruner_have_a_hint(study_in, pruner, is_hinted):
    study_in("before", {"agent.lr": LR}, rows=[({"agent.lr": 2e-3}, 2.0)])
    changes = {"warm_start": ["before"], "pruner": {"_target_": f"optuna.pruners.{pruner}Pruner"}}
    (told,) = begin(study_in("now", {"agent.lr": LR}, ZY, **changes), ZY)
    assert "the settings of the best 1 are tried first" in told
    assert ("study/pruner=percentile prunes fewer" in told) == is_hinted
    # Trials with their values are a sample of the space, which a median suits.
    (told,) = begin(study_in("again", {"agent.lr": LR}, **changes))
    assert told.endswith("1 taken with their values")


def test_numbers_outside_of_the_space_are_tried_with_their_nearest_values(study_in):
    rows = [
        ({"agent.gamma": 0.99, "agent.lr": 1e-4, "network": "mlp"}, 1.0),
        ({"agent.gamma": 0.5, "agent.lr": 2e-3, "network": "mlp"}, 2.0),
        ({"agent.gamma": 0.9, "agent.lr": 2e-3, "network": "cnn"}, 3.0),
    ]
    before = {"agent.gamma": {"choices": [0.5, 0.9, 0.99]}, "agent.lr": LR, "network": {"choices": ["mlp", "cnn"]}}
    study_in("before", before, rows=rows)
    space = {
        "agent.gamma": {"choices": [0.5, 0.95]},
        "agent.lr": LR | {"low": 1e-3},
        "network": {"choices": ["mlp", "multimodal"]},
    }
    made = study_in("now", space, ZY, warm_start=["before"])
    (told,) = begin(made, ZY)
    assert told.endswith(
        "the settings of the best 2 are tried first, 1 of them with the nearest values of the space, such as "
        "agent.gamma=0.95 instead of agent.gamma=0.99; 1 do not fit, such as: network=cnn is not in the space"
    )
    queued = [trial.system_attrs["fixed_params"] for trial in made[2].trials]
    assert queued == [
        {"agent.gamma": 0.95, "agent.lr": 1e-3, "network": "mlp"},
        {"agent.gamma": 0.5, "agent.lr": 2e-3, "network": "mlp"},
    ]


def test_settings_that_were_best_in_the_other_direction_are_not_tried(study_in):
    study_in("before", {"agent.lr": LR}, rows=[({"agent.lr": 1e-3}, 3.0)])
    made = study_in("now", {"agent.lr": LR}, warm_start=["before"], objectives={"mean_steps": "maximize"})
    (told,) = begin(made)
    assert told.endswith("none taken, because its objectives are minimize mean_steps")
    assert made[2].trials == []


def test_study_begins_once_also_where_a_process_ended_in_between(study_in, monkeypatch):
    study_in("before", {"agent.lr": LR}, rows=[({"agent.lr": 1e-3}, 3.0), ({"agent.lr": 2e-3}, 2.0)])
    asked, storage, study = study_in("now", {"agent.lr": LR}, warm_start=["before"])
    (each,) = initial_trials(asked, [], FIXED, study)

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(optuna.Study, "set_user_attr", killed)
        with pytest.raises(KeyboardInterrupt):
            each.add(storage, study)
    assert each.add(storage, study)
    assert not each.add(storage, study)
    assert len(study.trials) == 2
    assert initial_trials(asked, [], FIXED, study) == []


@pytest.mark.parametrize("name", ["elsewhere", "now"])
def test_study_that_is_not_there_is_refused_with_those_that_are(study_in, name):
    study_in("before", {"agent.lr": LR})
    asked, _, study = study_in("now", {"agent.lr": LR}, warm_start=[name])
    with pytest.raises(StudyError, match=f"warm_start names '{name}', but it must be .* of the storage: before$"):
        initial_trials(asked, [], FIXED, study)


def test_preset_whose_values_lie_in_the_space_is_tried_first():
    words = ["sweep=sac_zy", "study.enqueue=[default,best_zy]"]
    asked, _, config = read_settings(words)
    own, best = initial_trials(asked, words, to_plain(config), None)
    assert own.enqueued[0]["agent.lr_end_factor"] == 1.0
    other = {"agent.lr_end_factor": 0.1, "stack": 4, "memory": 2, "agent.target_entropy_per_dim": -3.0}
    assert best.enqueued == (own.enqueued[0] | other,)
    assert best.message.startswith(
        "of preset best_zy, the searched values are tried first: agent.lr=0.001 agent.lr_end_factor=0.1 "
    )


def test_preset_may_be_in_a_folder_of_the_search_path(tmp_path):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "ours.yaml").write_text("# @package _global_\nagent: {lr: 0.002}\n")
    words = ["sweep=sac_y", f"hydra.searchpath=[file://{tmp_path}]", "study.enqueue=[ours]"]
    asked, _, config = read_settings(words)
    (ours,) = initial_trials(asked, words, to_plain(config), None)
    assert ours.enqueued[0]["agent.lr"] == 0.002


def test_taken_trial_with_the_values_of_the_control_is_no_candidate_beside_it(study_in):
    space, words = {"agent.lr": LR, "stack": STACK}, ["sweep=sac_y", "agent.lr=2e-3"]
    control, misfit = values_of(Space.read(space), words)
    assert (control, misfit) == ({"agent.lr": 2e-3, "stack": 1}, None)
    study_in("before", space, rows=[(control, 1.0), (control | {"stack": 4}, 2.0)])
    final_eval = FinalEvalSettings(top_k=2, min_seeds=1, mean_seeds=1, test_seeds=1, episodes=3)
    asked, storage, study = made = study_in("now", space, warm_start=["before"], final_eval=final_eval)
    begin(made)
    assert open_final_eval(storage, asked, study, None).contenders() == [CONTROL, 0, 1]
    assert open_final_eval(storage, asked, study, control).contenders() == [CONTROL, 1]


def test_settings_of_a_taken_trial_are_not_tried_again(study_in):
    study_in("before", {"agent.lr": LR}, rows=[({"agent.lr": 1e-3}, 3.0)])
    asked, storage, study = study_in("now", {"agent.lr": LR}, warm_start=["before"])
    (taken,) = initial_trials(asked, [], FIXED, study)
    preset = InitialTrials("preset a", "", (), ({"agent.lr": 1e-3}, {"agent.lr": 2e-3}))
    for each in (taken, preset):
        each.add(storage, study)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "WAITING"]


def test_preset_whose_values_do_not_lie_in_the_space_is_not_tried():
    given = StudyCommand.read(["-m", "sweep=sac_y", "study.space.agent.lr.low=5e-3"])
    words = trial_overrides(given.overrides)
    asked, _, config = read_settings(words)
    (each,) = initial_trials(asked, words, to_plain(config), None)
    assert each.message == "preset best_y is not tried: agent.lr=0.001 is not in the space"
    assert each.enqueued == ()


@pytest.mark.parametrize("sweep", sorted(path.stem for path in sweeps_folder().glob("*.yaml")))
def test_presets_of_each_sweep_lie_in_its_space(sweep):
    words = [f"sweep={sweep}"]
    asked, _, config = read_settings(words)
    initial = initial_trials(asked, words, to_plain(config), None)
    assert [len(each.enqueued) for each in initial] == [1] * len(asked.enqueue)


def test_trials_that_a_study_has_already_are_not_taken_again(study_in):
    space, rows = {"agent.lr": LR}, [({"agent.lr": 1e-3}, 3.0), ({"agent.lr": 2e-3}, 2.0)]
    study_in("a", space, rows=rows)
    second = study_in("b", space, rows=[({"agent.lr": 3e-3}, 1.0)], warm_start=("a",))
    begin(second)
    # Those of "a" only once, however many sources have them.
    third = study_in("c", space, warm_start=("a", "b"))
    first_said, then_said = begin(third)
    assert "2 taken with their values" in first_said
    assert "which has 3 finished trials: 1 taken with their values; 2 already there" in then_said
    assert len(third[2].trials) == 3
    # Nor a study's own.
    asked, storage, study = study_in("a", space, warm_start=("b",))
    (said,) = begin((asked, storage, study))
    assert "1 taken with their values; 2 already there" in said
    assert len(study.trials) == 3
