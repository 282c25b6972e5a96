"""The user's configurations in the working folder, which come before armscan's own."""

import pytest
from hydra.errors import MissingConfigException

from armscan.config.choices import choices, choices_help
from armscan.config.compose import compose
from armscan.config.defaults import default_tracking
from armscan.config.sources import own_folders, sweeps_folder, working_folder
from armscan.config.trust import check_composed
from armscan.errors import InvalidValueError
from tests.support import REPOSITORY

MINE = "# @package _global_\n# One of my own.\ndefaults:\n  - /study/base\n  - _self_\nstudy:\n  name: mine\n"


@pytest.fixture
def working(tmp_path, monkeypatch):
    """Write files into an empty working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PWD", str(tmp_path))

    def write(**files):
        for name, text in files.items():
            path = tmp_path / f"{name.replace('__', '/')}.yaml"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path

    return write


def test_directory_is_called_as_its_user_calls_it_where_that_is_where_it_is(tmp_path, monkeypatch):
    called = tmp_path / "home"
    called.symlink_to(tmp_path)
    monkeypatch.chdir(called)
    monkeypatch.setenv("PWD", str(called))
    assert working_folder() == called
    monkeypatch.setenv("PWD", "/")
    assert working_folder() == tmp_path


def test_study_of_the_working_folder_is_found_by_its_name(working, capsys):
    working(sweeps__mine=MINE)
    assert compose(["sweep=mine", "study.n_trials=3"]).study.name == "mine"
    assert compose(["sweep=sac_y"]).study.name == "sac_y"
    with pytest.raises(MissingConfigException) as raised:
        compose(["sweep=foo"])
    assert {"mine", "sac_y"} < set(raised.value.options)
    assert capsys.readouterr().err == ""


def test_groups_of_the_working_folder_are_found_beside_those_of_armscan(working):
    working(conf__agent__mine="defaults: [sac, _self_]\nlr: 0.5\n", conf__mine__a="value: 1\n", conf__sweep__other=MINE)
    config = compose(["agent=mine", "+mine=a"])
    assert (config.agent.lr, config.agent._target_, config.mine.value) == (0.5, "armscan.agents.SAC", 1)
    assert compose(["sweep=other"]).study.name == "mine"


def test_own_file_replaces_that_of_the_same_name_and_one_line_says_so(working, capsys):
    folder = working(sweeps__sac_y=MINE, conf__tracking__mlflow="uri: sqlite:///mine.db\n")
    assert compose(["sweep=sac_y"]).study.name == "mine"
    assert default_tracking() == {"uri": "sqlite:///mine.db"}
    compose()
    said = "using ./conf/tracking/mlflow.yaml, ./sweeps/sac_y.yaml instead of armscan's own\n"
    assert capsys.readouterr().err == said
    # A copy of armscan's own file is not mentioned.
    (folder / "conf" / "tracking" / "mlflow.yaml").unlink()
    (folder / "sweeps" / "sac_y.yaml").write_bytes((sweeps_folder() / "sac_y.yaml").read_bytes())
    assert compose(["sweep=sac_y"]).study.name == "sac_y"
    assert capsys.readouterr().err == ""


def test_own_tracking_file_without_a_store_is_named(working):
    folder = working(conf__tracking__mlflow="experiment: mine\n")
    with pytest.raises(
        InvalidValueError, match=rf"{folder}/conf/tracking/mlflow.yaml has no key 'uri', but it replaces"
    ):
        default_tracking()


def test_what_editors_and_systems_leave_is_no_configuration(working):
    folder = working(conf__agent__mine="lr: 1\n")
    (folder / "conf" / "agent" / ".#mine.yaml").symlink_to("user@host.1")
    (folder / "conf" / "agent" / "._mine.yaml").write_bytes(b"\0\xff")
    assert "mine" in choices()["agent"]
    assert not [name for name in choices()["agent"] if name.startswith(".")]
    assert "  mine" in choices_help()
    check_composed({}, where="job 1")


def test_nothing_is_found_twice_in_the_checkout(monkeypatch, capsys):
    monkeypatch.chdir(REPOSITORY)
    assert own_folders() == {}
    assert compose(["sweep=sac_y"]).study.name == "sac_y"
    assert capsys.readouterr().err == ""


def test_study_in_a_subfolder_is_listed_as_it_is_chosen(working):
    folder = working(sweeps__lab__mine=MINE)
    (folder / "sweeps" / ".hidden.yaml").touch()
    assert "lab/mine" in choices()["sweep"]
    assert compose(["sweep=lab/mine"]).study.name == "mine"
    with pytest.raises(MissingConfigException) as raised:
        compose(["sweep=lab/other"])
    assert "lab/mine" in raised.value.options
    assert ".hidden" not in raised.value.options
