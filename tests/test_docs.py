"""The README and the pages: code blocks run, commands compose, and journeys succeed with small budgets."""

import json
import os
import re
import shlex
import subprocess
import sys
from importlib import import_module

import nbformat
import pytest
from click import ClickException
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from nbclient import NotebookClient

from armscan.cli.main import armscan as program
from armscan.errors import ArmscanError
from tests.support import REPOSITORY

DOCS = REPOSITORY / "docs"
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
# Values for the placeholders that a user fills in.
PLACEHOLDERS = {
    "FOLDER": ".",
    "RUN_ID": "0123abcd",
    "ID": "0123abcd",
    "PRESET": "best_y",
    "USER": "me",
    "HOST": "localhost",
    "SERVER": "localhost",
    "DATABASE": "armscan",
    "FILE": "plane",
}
# Options of Hydra, which `compose` does not know.
OF_HYDRA = {"-m", "--multirun", "--plan", "--help"}
# So that each command of a journey takes seconds.
SMALL = (
    *("training.env_steps=2064", "training.eval_every_env_steps=64", "training.validation_episodes=2"),
    *("evaluation.episodes=2", "tracking.policy=false"),
)
OF_PHANTOMS = ("data.n_training=2", "data.n_validation=1", "data.n_test=2")
OF_STUDIES = (
    *("study.n_trials=2", "study.final_eval.top_k=1", "study.final_eval.min_seeds=1"),
    *("study.final_eval.mean_seeds=1", "study.final_eval.test_seeds=1", "study.final_eval.episodes=3"),
)
OWN_VOLUMES = ("data=nifti", "data=mixed")


def blocks(page, language):
    """Return the code blocks of a page in a language, without the indentation of a list."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```", page.read_text(), re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indent}", "", block, flags=re.MULTILINE) for indent, block in found]


def commands(page):
    """Yield the words of each armscan command in a page's shell blocks."""
    for line in "\n".join(blocks(page, "sh")).replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words[:3] in (["python", "-m", "armscan.run"], [".venv/bin/python", "-m", "armscan.run"]):
            yield ["run", *words[3:]]
        elif words[:1] == ["armscan"] and words[1:] != ["--version"]:
            yield words[1:]


def filled_in(word):
    for placeholder, value in PLACEHOLDERS.items():
        word = re.sub(rf"\b{placeholder}\b", value, word)
    return word.replace("=NAME", "=sac_y") if word.startswith("sweep=") else re.sub(r"\bNAME\b", "random", word)


def of_each_sweep(words):
    """Yield the overrides of a command with the first choice of each key that has several."""
    for override in OverridesParser.create().parse_overrides(words):
        first = next(override.sweep_string_iterator()) if override.is_sweep_override() else None
        yield override.input_line if first is None else f"{override.get_key_element()}={first}"


COMMANDS = [
    pytest.param(page, words, id=f"{page.name}-{' '.join(words)}")
    for page in PAGES
    for words in commands(page)
    if words
]

# Runs as pages name them.
RUNS_OF_PAGES = {"ID", "RUN_ID", "3bf2", "4f2a,91c0", "experiment:armscan"}


@pytest.fixture
def in_a_folder(tmp_path, monkeypatch):
    """Return a folder with what commands of pages expect to be there."""
    for folder in ("outputs", "studies/sac_y"):
        (tmp_path / folder).mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    # Of commands for a cluster.
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://mlflow:5000")
    monkeypatch.setenv("ARMSCAN_STORAGE", "postgresql://optuna@database/optuna")
    return tmp_path


def mistake_in(words):
    """Return the error of a command's options, or of the configuration that it composes; None if both are valid."""
    from armscan.config.compose import compose
    from armscan.experiment.build import check_config

    try:
        if words[0] != "run":
            path = words[: 1 + (words[0] in ("runs", "data", "policy"))]
            command = program
            for name in path:
                command = command.commands[name]
            command.make_context(" ".join(path), words[len(path) :])
        elif not any(word.startswith("resume=") for word in words):
            check_config(compose(list(of_each_sweep([word for word in words[1:] if word not in OF_HYDRA]))))
    except (ArmscanError, ClickException, HydraException) as error:
        return str(error)
    return None


@pytest.mark.full
@pytest.mark.parametrize(("page", "words"), COMMANDS)
def test_commands_of_pages_are_valid(page, words, in_a_folder):
    write_files(page, in_a_folder)
    assert mistake_in([filled_in(word) for word in words]) is None


@pytest.mark.full
def test_study_of_the_page_on_docker_is_valid():
    pattern = r"^ARMSCAN_SWEEP=(.*)\n(?:.*\n)*?ARMSCAN_WORDS=(.*)"
    sweep, words = re.search(pattern, (DOCS / "docker.md").read_text(), re.M).groups()
    assert mistake_in(["run", f"sweep={sweep}", *shlex.split(words)]) is None


@pytest.mark.full
def test_mistake_in_a_command_is_found():
    assert "No such option" in mistake_in(["runs", "list", "--nowhere"])
    assert "agent.nowhere" in mistake_in(["run", "agent.nowhere=1"])
    assert "data.n_training" in mistake_in(["run", "experiment=best_full", "data=nifti", "data.path=."])


def write_files(page, folder):
    """Write the files that a page shows as they stand; a comment at their head names them."""
    for block in (*blocks(page, "python"), *blocks(page, "yaml")):
        if name := re.match(r"(?:# @package _global_\n)?# ([\w./]+\.(?:py|yaml))\n", block):
            file = folder / name[1]
            file.parent.mkdir(parents=True, exist_ok=True)
            with file.open("a") as opened:
                opened.write(block)


@pytest.mark.parametrize("page", [REPOSITORY / "README.md", DOCS / "environment.md"], ids=lambda page: page.name)
def test_code_of_pages_runs(page):
    names = {"__name__": page.stem}
    exec(compile("\n".join(blocks(page, "python")), str(page), "exec"), names)
    assert names["env"].observation_space.contains(names["observation"])


def test_tutorial_runs_as_it_stands(data_folder, tmp_path, monkeypatch, capsys):
    (tmp_path / "wrists").symlink_to(data_folder)
    monkeypatch.chdir(tmp_path)
    code = "\n".join(blocks(DOCS / "tutorial.md", "python"))
    exec(compile(code, "docs/tutorial.md", "exec"), {"__name__": "tutorial"})
    assert "00001_labels.nii.gz (360, 800, 80)" in capsys.readouterr().out


def armscan(words, folder):
    """Run armscan in its own process, in a folder."""
    command = [sys.executable, "-P", "-m", "armscan", *words]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


def small(words):
    """Return a command with small budgets in the place of its own."""
    budgets = [*SMALL]
    if not set(words) & set(OWN_VOLUMES):
        budgets += OF_PHANTOMS
    if any(word.startswith("sweep=") for word in words):
        budgets += OF_STUDIES
    keys = {word.partition("=")[0] for word in budgets}
    return [*(word for word in words if word.partition("=")[0] not in keys), *budgets]


@pytest.mark.parametrize(
    "page",
    [
        pytest.param("README.md", marks=pytest.mark.full),
        *(
            pytest.param(f"docs/{name}.md", marks=pytest.mark.slow)
            for name in ("first-training", "first-study", "own-volumes", "extending")
        ),
    ],
)
def test_journeys_of_pages_are_made_with_small_budgets(page, tmp_path, data_folder):
    write_files(REPOSITORY / page, tmp_path)
    done = 0
    for words in commands(REPOSITORY / page):
        line = [word.replace("FOLDER", str(data_folder)) for word in words]
        if "ui" in line or "label" in line or any("resume=" in word or word == "ID" for word in line):
            continue
        if line[0] == "run" and "--help" not in line:
            line = small(line)
        ended = armscan(line, tmp_path)
        assert ended.returncode == 0, (line, ended.stdout[-3000:], ended.stderr[-3000:])
        done += 1
    assert done


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Return a folder with the store of one training, and its run ID."""
    folder = tmp_path_factory.mktemp("trained")
    ended = armscan(["run", *SMALL[:-1], *OF_PHANTOMS], folder)
    assert ended.returncode == 0, ended.stderr[-3000:]
    (run,) = json.loads(armscan(["runs", "list", "--format", "json"], folder).stdout)
    return folder, run["run_id"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "words"),
    [each for each in COMMANDS if RUNS_OF_PAGES & {*each.values[1]} and "stop" not in each.values[1]],
)
def test_commands_of_pages_about_a_run_succeed(page, words, trained, data_folder):
    folder, run_id = trained
    out = words.index("--out") + 1 if "--out" in words else None
    line = [
        "exported" if place == out else re.sub(r"\b(RUN_ID|ID|3bf2|4f2a|91c0)\b", run_id, word)
        for place, word in enumerate(words)
    ]
    ended = armscan([filled_in(word.replace("FOLDER", str(data_folder))) for word in line], folder)
    assert ended.returncode == 0, (line, ended.stdout[-3000:], ended.stderr[-3000:])


@pytest.mark.full
@pytest.mark.parametrize("page", ["first-study", "write-study", "extending"])
def test_studies_of_pages_can_be_planned(page, tmp_path):
    write_files(DOCS / f"{page}.md", tmp_path)
    (sweep,) = (tmp_path / "sweeps").glob("*.yaml")
    ended = armscan(["run", "-m", f"sweep={sweep.stem}", "--plan"], tmp_path)
    assert ended.returncode == 0, ended.stderr[-3000:]
    assert f"study {sweep.stem}: what is searched" in ended.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_page_links_to_what_is_there(page):
    for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_page_hides_no_line_of_its_text(page):
    # To Sphinx's reader of Markdown, such a line is a comment; a per cent sign gets there when text is wrapped.
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    assert re.findall(r"^\s*%.*", text, re.MULTILINE) == []


def test_readme_is_short():
    assert len((REPOSITORY / "README.md").read_text().split()) <= 800


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_on_the_site_load_nothing_from_elsewhere(notebook, monkeypatch):
    monkeypatch.syspath_prepend(DOCS / "_ext")
    from_this_site = import_module("local_plotly").from_this_site
    outputs = [output for cell in nbformat.read(notebook, as_version=4).cells for output in cell.get("outputs", [])]
    charts = [html for output in outputs if "plotly" in (html := output.get("data", {}).get("text/html", "").lower())]
    assert charts
    for chart in charts:
        assert "https://cdn" in chart
        assert not re.search(r"""(src=|import )["']https?:""", from_this_site(chart))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.parametrize(
    "is_small",
    [
        pytest.param(True, marks=pytest.mark.full, id="small budgets"),
        pytest.param(False, marks=pytest.mark.slow, id="as they stand"),
    ],
)
def test_notebooks_run(notebook, is_small, tmp_path):
    cells = nbformat.read(notebook, as_version=4)
    ran = [cell.execution_count for cell in cells.cells if cell.cell_type == "code"]
    assert ran == [*range(1, len(ran) + 1)], "outputs are kept with the notebook, from one run from top to bottom"
    assert cells.cells[-1].outputs
    for cell in cells.cells if is_small else ():
        if "armscan run" in cell.source:
            (command,) = re.findall(r"armscan (run.*?) \| cat", cell.source, re.DOTALL)
            words = small(shlex.split(command.replace("\\\n", " ")))
            # A later cell plays the policy.
            words.remove("tracking.policy=false")
            cell.source = f"!armscan {shlex.join(words)} | cat"
    NotebookClient(cells, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
