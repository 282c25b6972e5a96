"""The program: its commands with good and bad arguments, its exit codes, and what it imports."""

import os
import subprocess
import sys
from subprocess import PIPE

import click
import pytest

from armscan.cli.evaluate import evaluate
from armscan.cli.main import armscan as program
from armscan.cli.main import main
from armscan.config.defaults import CHANGES
from armscan.errors import VolumeError
from tests.support.stores import store_in


def commands(group=program, path=()):
    """Yield every command with its path, except `run`, which is Hydra's."""
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from commands(command, (*path, name))
        elif name != "run":
            yield (*path, name), command


COMMANDS = dict(commands())
EXAMPLES = [line.split()[1:] for command in COMMANDS.values() for line in command.epilog.splitlines()[2:]]


def test_commands_are_those_of_the_documentation():
    assert {" ".join(path) for path in COMMANDS} == {
        *("evaluate", "report", "ui", "policy export", "policy register", "data inspect", "data label", "data explore"),
        *("runs list", "runs show", "runs stop", "runs prune", "runs sync", "runs reproduce"),
    }


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_command_explains_itself_and_each_option(path, capsys):
    assert main([*path, "--help"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"Usage: armscan {' '.join(path)} ")
    assert f"\n  Examples:\n    armscan {' '.join(path)}" in printed
    assert all(option.help for option in COMMANDS[path].params if isinstance(option, click.Option))


@pytest.mark.parametrize("words", EXAMPLES, ids=" ".join)
def test_examples_are_valid_arguments(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("outputs", "studies/sac_y"):
        (tmp_path / folder).mkdir(parents=True)
    path = next(path for path in COMMANDS if list(path) == words[: len(path)])
    context = COMMANDS[path].make_context(" ".join(path), words[len(path) :])
    assert context.args == []


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_command_refuses_an_unknown_option_in_one_line(path, capsys):
    assert main([*path, "--qqq=1"]) == 2
    assert capsys.readouterr() == ("", "error: No such option '--qqq'.\n")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["nonsense"], "error: No such command 'nonsense'.\n"),
        (["runs", "nonsense"], "error: No such command 'nonsense'.\n"),
        (["--nonsense"], "error: No such option '--nonsense'.\n"),
        (["report", "--study"], "error: Option '--study' requires an argument.\n"),
    ],
)
def test_program_refuses_invalid_arguments_in_one_line(words, line, capsys):
    assert main(words) == 2
    assert capsys.readouterr() == ("", line)


@pytest.mark.parametrize("path", [(), ("runs",), ("policy",), ("data",)])
def test_group_without_a_command_shows_its_help(path, capsys):
    assert main(path) == 2
    assert capsys.readouterr().err.startswith(f"Usage: {' '.join(['armscan', *path])} [OPTIONS] COMMAND")


@pytest.mark.parametrize(
    "words", [["ui", "--storage=postgresql://me:secret@host/db"], ["report", "--tracking=http://me:secret@host"]]
)
def test_passwords_in_addresses_are_refused(words, capsys):
    assert main(words) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"error: {words[1].partition('=')[0]} has a password in its address")
    assert "secret" not in printed


def raising(monkeypatch, error):
    def callback(**_):
        raise error

    monkeypatch.setattr(COMMANDS["data", "inspect"], "callback", callback)
    return main(["data", "inspect", "folder"])


def test_mistakes_and_interrupts_are_one_line(monkeypatch, capsys):
    assert raising(monkeypatch, VolumeError("a: is no\n volume")) == 2
    assert capsys.readouterr().err == "error: a: is no volume\n"
    assert raising(monkeypatch, KeyboardInterrupt()) == 130
    assert capsys.readouterr().err == "\ninterrupted\n"


def test_reader_that_has_ended_is_no_mistake(tmp_path, database):
    store, experiment_id = store_in(tmp_path, "a")
    store.create_run(experiment_id, name="n", tags={})
    list_runs = "import sys; from armscan.cli.main import main; sys.exit(main(['runs', 'list', '--format', 'csv']))"
    with subprocess.Popen([sys.executable, "-c", list_runs], cwd=tmp_path, stdout=PIPE, stderr=PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 1


def test_faults_of_the_program_are_not_hidden(monkeypatch):
    with pytest.raises(ZeroDivisionError):
        raising(monkeypatch, ZeroDivisionError())
    monkeypatch.setenv("ARMSCAN_TRACEBACKS", "1")
    with pytest.raises(VolumeError):
        raising(monkeypatch, VolumeError("a: is no volume"))


def test_run_is_passed_on_untouched(monkeypatch):
    import armscan.run

    taken = []
    monkeypatch.setattr(sys, "argv", ["armscan", "run"])
    monkeypatch.setattr(armscan.run, "main", lambda: taken.append(sys.argv[1:]) or 7)
    words = ["-m", "--", "agent=sac", "--help", "~x", "--cfg", "job"]
    assert main(["run", *words]) == 7
    assert taken == [words]


@pytest.mark.parametrize(
    "words",
    [
        ["run", "agent=middle"],
        ["evaluate", "--agent", "middle", "--data", "phantom", "--phantoms", "1", "--episodes", "2"],
    ],
)
def test_classes_in_the_current_folder_are_found(words, tmp_path):
    (tmp_path / "conf/agent").mkdir(parents=True)
    (tmp_path / "conf/agent/middle.yaml").write_text("_target_: own_agent.Middle\n")

    def error():
        # -P: like the installed program, which does not have the current folder on its path.
        command = [sys.executable, "-P", "-m", "armscan", *words]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stderr

    assert "agent._target_ cannot be imported: No module named 'own_agent'" in error()
    (tmp_path / "own_agent.py").write_text("raise ImportError('it was found')")
    assert "agent._target_ cannot be imported: it was found" in error()
    (tmp_path / "own_agent.py").write_text("class Left: ...")
    assert "agent._target_ cannot be imported: own_agent has no Middle" in error()
    (tmp_path / "own_agent.py").write_text("class Middle")
    assert "agent._target_ cannot be imported: SyntaxError: " in error()


def test_evaluate_has_an_option_for_each_rule():
    options = {parameter.name for parameter in evaluate.params}
    assert CHANGES.keys() <= options
    named = {*("run", "agent", "data", "phantoms", "episodes", "seed", "video", "out", "tracking", "trust")}
    assert options - CHANGES.keys() == named | {"tracking_experiment"}


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_shells_complete_commands(shell):
    command = [sys.executable, "-m", "armscan"]
    variables = {"_ARMSCAN_COMPLETE": f"{shell}_complete", "COMP_WORDS": "armscan runs s", "COMP_CWORD": "2"}
    ended = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, check=True)
    assert "show" in ended.stdout
    assert "sync" in ended.stdout
