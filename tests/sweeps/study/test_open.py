"""A study opened for work, and the runs of the tracking store that its storage names."""

import re
import shutil
from types import SimpleNamespace

import optuna
import pytest
from mlflow import MlflowClient
from optuna.trial import TrialState
from optuna_dashboard import get_note, save_note

from armscan.errors import StudyError, TrackingError
from armscan.sweeps.storage.attribute_names import NOTE_SUM, STUDY_RUN
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.dashboard import note_run
from armscan.sweeps.study.open import OWNER_FILE, _claim_folder, check_owner
from armscan.sweeps.study.study import make_study
from tests.sweeps.study.test_study import settings


@pytest.mark.parametrize("kind", ["another study's", "a trial's", "of another experiment", "nobody's"])
def test_run_of_a_study_that_is_anothers_is_refused_and_left_as_it_is(opened, kind):
    phase = opened().search
    client, experiment_id = opened.store
    others = client.create_experiment("other")
    experiment, tags = {
        "another study's": (experiment_id, {"study": "b"}),
        "a trial's": (experiment_id, {"study": "a", "trial": "3"}),
        "of another experiment": (others, {"study": "a"}),
        "nobody's": (experiment_id, {}),
    }[kind]
    victim = client.create_run(experiment, name="n", tags=tags)
    phase.scheduler.study.set_user_attr(STUDY_RUN, victim.info.run_id)
    line = f"a.user_attrs.mlflow_run names run {victim.info.run_id}, which is another's"
    with pytest.raises(TrackingError, match=line):
        opened()
    now = client.get_run(victim.info.run_id)
    assert (now.info.status, now.data.tags) == ("RUNNING", victim.data.tags)


def note_result(search, result):
    """Add a result to a study's note, as its launcher does; return the note that the dashboard shows."""
    study = search.scheduler.study
    note_run(study, search.store, search.experiment_id, search.run_id, search.folder, result)
    return get_note(study)


def test_note_of_a_study_has_its_run_and_its_latest_result(opened):
    search = opened().search
    begun = get_note(search.scheduler.study)
    assert search.run_id in begun
    assert note_result(search, "early") == f"{begun}\n\nearly"
    assert note_result(opened().search, "late") == f"{begun}\n\nlate"


@pytest.mark.parametrize("results", [[], ["early"]], ids=["begun", "with a result"])
def test_note_that_somebody_has_changed_stays(opened, results):
    search = opened().search
    for result in results:
        note_result(search, result)
    mine = f"{get_note(search.scheduler.study)}\n\nmine"
    save_note(search.scheduler.study, mine)
    assert note_result(search, "late") == mine


def test_note_of_a_study_of_an_earlier_version_gets_its_result(opened, monkeypatch):
    with monkeypatch.context() as earlier:
        earlier.setattr(optuna.Study, "set_user_attr", unless_named(NOTE_SUM))
        search = opened().search
    assert NOTE_SUM not in search.scheduler.study.user_attrs
    assert note_result(search, "late").endswith("late")


def unless_named(left_out, set_user_attr=optuna.Study.set_user_attr):
    """Return the function that sets a user attribute, but not this one."""
    return lambda study, name, value: None if name == left_out else set_user_attr(study, name, value)


def test_study_goes_on_with_its_own_run(opened):
    assert opened().search.run_id == opened().search.run_id


def test_run_of_a_study_shows_the_overrides_of_the_latest_command_and_not_those_of_its_workers(opened):
    client, _ = opened.store
    command = {"volumes": {}}
    for overrides, given in ((["seed=1"], command), (["seed=2"], command), (["seed=2", "sampler.seed=3"], {})):
        run_id = opened(overrides=overrides, **given).search.run_id
    assert client.get_run(run_id).data.tags["overrides"] == "seed=2"


def test_runs_of_a_study_of_the_same_name_in_another_storage_are_not_ended(opened):
    first, second = opened("first.journal").search, opened("second.journal").search
    client, experiment_id = opened.store
    runs = [
        client.create_run(experiment_id, name="n", tags=phase.tags_of(phase.scheduler.study.ask())).info.run_id
        for phase in (first, second)
    ]
    first.scheduler.study.tell(0, state=TrialState.FAIL)
    first.close_orphaned_runs()
    assert [client.get_run(run_id).info.status for run_id in runs] == ["FAILED", "RUNNING"]


@pytest.mark.parametrize("is_finished", [False, True])
def test_run_that_a_requeued_trial_does_not_know_is_ended_also_if_the_trial_has_finished_since(opened, is_finished):
    phase = opened().search
    client, experiment_id = opened.store
    study = phase.scheduler.study
    study.enqueue_trial({"agent.lr": 1e-3})
    (requeued,) = study.get_trials(deepcopy=False)
    unknown, known = (
        client.create_run(experiment_id, name="n", tags=phase.tags_of(requeued)).info.run_id for _ in range(2)
    )
    study._storage.set_trial_user_attr(requeued._trial_id, "mlflow_run", known)
    if is_finished:
        study.tell(study.ask(), 0.5)
    phase.close_orphaned_runs()
    assert [client.get_run(run_id).info.status for run_id in (unknown, known)] == ["KILLED", "RUNNING"]


def test_study_that_is_damaged_while_it_runs_says_so_in_one_line(opened):
    phase = opened().search
    other = optuna.load_study(study_name="a", storage=open_storage("optuna.journal").optuna)
    other.set_user_attr("forgiven", 3)
    scheduler = phase.scheduler
    trial = scheduler.study.ask()
    scheduler.study.tell(trial, state=TrialState.FAIL)
    with pytest.raises(ValueError, match=r"study.user_attrs.forgiven is 3, but it must be a list of numbers"):
        scheduler.failure_reason(scheduler.state())


def test_folder_of_another_study_is_refused(opened):
    first = opened(name="a")
    assert opened(name="a").folder == first.folder
    other = first.folder.with_name("b")
    first.folder.rename(other)
    with pytest.raises(StudyError, match="which has the files of a: give study"):
        opened(name="b")
    with pytest.raises(StudyError, match="which has the files of a: give study"):
        check_owner(other, "b")
    check_owner(other, "a")
    # Files of an earlier version, which wrote no name.
    (other / OWNER_FILE).unlink()
    (other / "trials").mkdir()
    assert opened(name="b").folder == other


def test_folder_that_an_earlier_version_has_given_another_study_is_refused(tmp_path, storage_uri):
    study = make_study(open_storage(storage_uri), settings(storage=storage_uri), {})
    (tmp_path / "shared" / "trials").mkdir(parents=True)
    with pytest.raises(StudyError, match="which has the files of another study"):
        _claim_folder(tmp_path / "shared", study)


@pytest.mark.parametrize("is_population", [False, True])
def test_study_that_was_begun_in_another_folder_notes_it_and_a_population_is_refused(
    opened, monkeypatch, capsys, is_population
):
    monkeypatch.setattr(
        "armscan.sweeps.study.open.population_of", lambda *_: SimpleNamespace() if is_population else None
    )
    first = opened(volumes={}).folder
    moved = first.rename(first.with_name("moved"))
    begun = rf"[^ ]+:{re.escape(str(first.absolute()))}"
    where = rf"study.folder is 'studies/a', but the study a was begun in {begun}, and its files are not here: "
    if is_population:
        with pytest.raises(StudyError, match=f"{where}its members copy checkpoints"):
            opened(volumes={})
    else:
        assert opened().folder == first
        assert capsys.readouterr().out == ""
        opened(volumes={})
        # Without the blanks of lines that are broken at the width of the terminal.
        printed = "".join(capsys.readouterr().out.split())
        assert re.match(f"note: {where}trials that were".replace(" ", "").replace("[^]", "[^ ]"), printed)
    shutil.rmtree(first)
    # It may be seen by another path.
    moved.rename(first)
    assert opened(volumes={}).folder == first
    assert capsys.readouterr().out == ""


def test_study_whose_run_was_deleted_in_mlflow_names_the_command_that_restores_it(opened):
    run_id = opened().search.run_id
    store, _ = opened.store
    MlflowClient(store.uri).delete_run(run_id)
    line = (
        f"a.user_attrs.mlflow_run names run {run_id}, which was deleted in MLflow: restore it with mlflow runs restore"
    )
    with pytest.raises(TrackingError, match=line):
        opened()


def test_study_that_was_deleted_while_it_ran_is_not_created_again(opened):
    search = opened().search
    storage = search.scheduler.storage
    optuna.delete_study(study_name="a", storage=storage.optuna)
    with pytest.raises(StudyError, match="was deleted from its storage while it ran"):
        search.scheduler.state()
    with pytest.raises(StudyError, match="not in its storage any more"):
        opened(is_worker=True)
    assert storage.study_names == []
