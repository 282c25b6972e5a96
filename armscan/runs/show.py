"""Everything about one run, in the terminal."""

from __future__ import annotations

from collections.abc import Collection

from mlflow.entities import Run
from rich.console import Console
from rich.filesize import decimal
from rich.markdown import Markdown
from rich.table import Column
from rich.text import Text

from armscan.config.command_hints import armscan_command, resume_command
from armscan.config.trust import TRUST, needs_trust
from armscan.errors import in_one_line, printable
from armscan.experiment.results import BEST_VALIDATION, LAST_VALIDATION, evaluation_table, figures_of, result_table
from armscan.runs.rows import RunRow, artifacts_of
from armscan.runs.run_folder import OwnFolder, RunSkippedError
from armscan.tracking import TrackingStore
from armscan.tracking.tags import (
    AGENT_TAG,
    BEST_TAG,
    COMMAND_TAG,
    DESCRIPTION_TAG,
    EVALUATED_TAG,
    FAILURE_TAG,
    OVERRIDES_TAG,
    PARENT_TAG,
    STUDY_TAG,
    TRIAL_TAG,
)
from armscan.tracking.uploader import DESCRIPTION_SUM_TAG
from armscan.utils.console import narrow_table, wide_console
from armscan.utils.files import sha256
from armscan.utils.run_files import BEST_CHECKPOINT, ID_CHARS, LAST_CHECKPOINT
from armscan.utils.text import format_duration

# Tags that say how a run was started; the first one that it has is shown.
STARTED_BY = (COMMAND_TAG, OVERRIDES_TAG)
MAX_VALUE_CHARS = 200


def show(store: TrackingStore, run: Run, uri: str) -> None:
    """Print a run's start and end, its figures, files and children, and the commands that use it."""
    console, entry = wide_console(), RunRow(store, run)
    tags = {name: value for name, value in run.data.tags.items() if value}
    _print_pairs(console, "", _facts(run, entry))
    _print_figures(console, run)
    shown = {*STARTED_BY, FAILURE_TAG, PARENT_TAG}
    others = {name: tags[name] for name in sorted(tags) if name not in shown and not name.startswith("mlflow.")}
    _print_pairs(console, "tags", others)
    artifacts = artifacts_of(store, run)
    folder = _print_folder(console, run)
    if artifacts is None:
        _print_pairs(console, f"artifacts in {run.info.artifact_uri}: they cannot be read", {})
    else:
        _print_sizes(console, f"artifacts in {run.info.artifact_uri}", artifacts)
    children = store.children(run.info.experiment_id, run.info.run_id)
    if children:
        console.print("\nchildren", style="bold")
        table = narrow_table(
            Column("id", no_wrap=True), Column("name", overflow="fold"), Column("status", no_wrap=True)
        )
        for child in sorted(children, key=lambda child: child.info.start_time):
            table.add_row(child.info.run_id[:ID_CHARS], Text(printable(child.info.run_name)), child.info.status.lower())
        console.print(table)
    _print_commands(console, uri, run, folder, artifacts or {})


def _facts(run: Run, entry: RunRow) -> dict[str, str]:
    """Return how a run was started, and how it has ended."""
    tags, info = run.data.tags, run.info
    how = next((name for name in STARTED_BY if tags.get(name)), None)
    ended = "" if entry.duration_s is None else f" after {format_duration(entry.duration_s)}"
    facts = {
        "run": info.run_id,
        "name": info.run_name,
        "status": f"{info.status.lower()}{ended}",
        "failure": tags.get(FAILURE_TAG, ""),
        "started": f"{entry.started:%Y-%m-%d %H:%M:%S}",
        how or "": tags.get(how or "", ""),
        "parent": tags.get(PARENT_TAG, ""),
    }
    return {name: value for name, value in facts.items() if name and value}


def _print_pairs(console: Console, title: str, pairs: dict[str, str], values: Column | None = None) -> None:
    """Print names with their values, by default in a column that wraps."""
    if title:
        console.print(Text(f"\n{printable(title)}", style="bold"), soft_wrap=True)
    table = narrow_table(Column(overflow="fold"), values or Column(overflow="fold"))
    table.show_header = False
    for name, value in pairs.items():
        whole = in_one_line(value)
        cut = f"{whole[:MAX_VALUE_CHARS]}…" if len(whole) > MAX_VALUE_CHARS and name not in STARTED_BY else whole
        table.add_row(Text(printable(name)), Text(printable(cut)))
    if pairs:
        console.print(table)


def _print_figures(console: Console, run: Run) -> None:
    """Print the final evaluations, the baselines and the last validation; the result of a study or an evaluation."""
    metrics, tags = run.data.metrics, run.data.tags
    of_study = STUDY_TAG in tags and AGENT_TAG not in tags
    result = tags.get(DESCRIPTION_TAG, "")
    is_ours = sha256(result.encode()) == tags.get(DESCRIPTION_SUM_TAG)
    has_result = EVALUATED_TAG in tags or (of_study and TRIAL_TAG not in tags)
    if has_result and is_ours:
        console.print(Text("\nresult", style="bold"))
        console.print(Markdown("\n".join(map(printable, result.splitlines()))))
        return
    figures = figures_of(metrics)
    # Runs of studies and trials have the best epoch, those of trainings end with the last.
    named = {BEST_VALIDATION if of_study and name == LAST_VALIDATION else name: each for name, each in figures.items()}
    table = evaluation_table(metrics) if EVALUATED_TAG in tags else result_table(named)
    if table.results:
        best = tags.get(BEST_TAG)
        console.print(f"\nfigures{f' of its best job, {best[:ID_CHARS]}' if best else ''}", style="bold")
        for part in table.show(console.width):
            console.print(part)


def _print_folder(console: Console, run: Run) -> OwnFolder | None:
    """Print the files in the run's folder and the process that uses it; return the folder."""
    try:
        ours = OwnFolder.of(run)
    except RunSkippedError as error:
        _print_pairs(console, f"folder: {error}", {})
        return None
    sizes = {str(file.relative_to(ours.path)): n_bytes for file, n_bytes in ours.files().items()}
    _print_sizes(console, f"folder {ours.path}", sizes)
    try:
        with ours.held(is_planned=True):
            pass
    except RunSkippedError as error:
        console.print(Text(str(error)), soft_wrap=True)
    return ours


def _print_sizes(console: Console, where: str, files: dict[str, int]) -> None:
    sizes = {name: decimal(n_bytes) for name, n_bytes in sorted(files.items())}
    _print_pairs(console, f"{where}, {decimal(sum(files.values()))}", sizes, Column(justify="right", no_wrap=True))


def _print_commands(console: Console, uri: str, run: Run, folder: OwnFolder | None, artifacts: Collection[str]) -> None:
    """Print the commands that resume a run, evaluate and record its agent, if it has kept what they need."""
    run_id, trust = run.info.run_id, needs_trust(run.data.params)
    commands = {}
    if folder is not None and (folder.path / LAST_CHECKPOINT).exists() and run.info.status != "FINISHED":
        commands["resume"] = resume_command(run_id, uri, trust=trust)
    if EVALUATED_TAG not in run.data.tags and BEST_CHECKPOINT in artifacts:
        commands["evaluate"] = armscan_command("evaluate", run_id, tracking=uri, trust=trust)
        commands["record"] = armscan_command("evaluate", run_id, "--video", tracking=uri, trust=trust)
    if commands:
        console.print()
        if trust:
            console.print(f"its configuration names classes that are not armscan's: {TRUST} executes their code")
    for what, command in commands.items():
        console.print(Text(f"{what:10}{command}"), soft_wrap=True)
