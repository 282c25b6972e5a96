"""Evaluate an agent, and keep the report: as a JSON file, and as an MLflow run below the evaluated run."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from armscan.config.defaults import to_plain
from armscan.errors import InvalidValueError
from armscan.evaluation.agent_source import EvaluatedAgent
from armscan.evaluation.report import EvaluationReport
from armscan.evaluation.runner import PreparedAgent
from armscan.evaluation.volumes import check_out, data_name, file_name
from armscan.experiment.build import on_plane_of
from armscan.reports.html import page
from armscan.tracking import TrackedRun, TrackingStore, check_artifacts, open_store, upload_pending
from armscan.tracking.tags import EVALUATED_TAG
from armscan.utils.files import atomic_write
from armscan.utils.run_files import ID_CHARS

FOLDER, SUFFIX = Path("evaluations"), ".json"
# Keys of the JSON file of every evaluation.
REPORT_KEYS = {"of", "name", "splits", "volumes", "episodes", "tracked_as"}


def evaluate_and_track(
    prepared: PreparedAgent,
    tracking: Mapping[str, Any],
    *,
    n_episodes: int,
    seed: int,
    out: Path | None,
) -> tuple[EvaluationReport, Path]:
    """Evaluate an agent, write the report as JSON, and track it.

    Args:
        prepared: Agent on its volumes.
        tracking: Section `tracking` of the configuration, used for an agent without a run.
        n_episodes: Number of episodes for each group of volumes.
        seed: Seed of the evaluation, which the seeds of its episodes follow from.
        out: JSON file to write; None: a new one in `evaluations`.

    Returns:
        The report, and its JSON file.

    Raises:
        ArmscanError: If the report cannot be written or tracked.
    """
    source = prepared.source
    _check_out(out)
    store, experiment_id = _store_of(source, tracking)
    upload_pending(store)
    limits = on_plane_of(source.config)
    of, data = source.run.run_id if source.run else source.name, data_name(prepared.data)
    facts = {
        "of": of,
        "name": source.name,
        "data": prepared.data or data,
        "episodes_a_split": n_episodes,
        "seed": seed,
        "changes": dict(source.changes),
        "notes": list(prepared.notes),
    }
    with TrackedRun.start(
        store,
        experiment_id,
        name=", ".join([f"evaluation: {source.name} on {data}", *source.changed_rules]),
        config={**to_plain(source.config), "evaluation": {**facts, "on_plane": [list(each) for each in limits]}},
        tags={EVALUATED_TAG: of},
        folder=FOLDER,
        parent_id=source.run.run_id if source.run else None,
    ) as tracked:
        evaluations, baselines = prepared.evaluate(n_episodes, seed, tell=partial(print, flush=True))
        # An agent's own training and test volumes are never merged into one total.
        report = EvaluationReport(
            evaluations,
            has_total=prepared.is_new,
            facts={**facts, "tracked_as": tracked.run_id},
            baselines=baselines,
        )
        for group, metrics in report.metrics().items():
            named = {f"{group}/{name}": value for name, value in metrics.items()}
            tracked.log_metrics(named, n_env_steps=source.n_env_steps)
        own = FOLDER / f"{file_name(source.name, data, tracked.run_id[:ID_CHARS])}{SUFFIX}"
        file = out or own
        atomic_write(file, json.dumps(report.to_dict(), indent=1, allow_nan=False), follow_link=True)
        description, shown = _described(prepared, report, tracked.name)
        atomic_write(own.with_suffix(".html"), shown)
        tracked.set_description(description)
        tracked.log_files(file, own.with_suffix(".html"))
    return report, file


def _described(prepared: PreparedAgent, report: EvaluationReport, title: str) -> tuple[str, str]:
    """Return the tables of an evaluation with their notes, as Markdown and as an HTML page."""
    notes = [*notes_on_rules(prepared.source), *prepared.notes]
    sections, described = [], [f"Note: {note}." for note in notes]
    for label, table in report.tables().items():
        of_label = [f"Note: {note}." for note in notes_on(prepared, report, label)]
        paragraphs = "".join(f"<p>{html.escape(note)}</p>" for note in of_label)
        sections.append(f"<h2>{html.escape(label)}</h2>{table.html()}{paragraphs}")
        described += [f"### {label}", table.markdown(), *of_label]
    return "\n\n".join(described), page(title, "".join(sections), notes=notes)


def notes_on(prepared: PreparedAgent, report: EvaluationReport, label: str) -> list[str]:
    """Return the notes on the metrics of a group of volumes."""
    used = "the agent's run has used some of these volumes, so this is no result on new wrists"
    return [*report.notes(label), *([used] if label in prepared.own else [])]


def notes_on_rules(source: EvaluatedAgent) -> list[str]:
    """Return the notes on rules that differ from the agent's configuration: one, or none if no rule was changed."""
    return [f"changed for this evaluation: {', '.join(source.changed_rules)}"] if source.changes else []


def _store_of(source: EvaluatedAgent, tracking: Mapping[str, Any]) -> tuple[TrackingStore, str]:
    """Return the tracking store of an evaluation, and the ID of its MLflow experiment: those of the agent's run."""
    if source.run is None:
        return open_store(**tracking)
    check_artifacts(source.run.store, source.run.experiment_id)
    return source.run.store, source.run.experiment_id


def _check_out(out: Path | None) -> None:
    """Check that the JSON file can be written, and would replace only an evaluation."""
    file = out or FOLDER / "evaluation.json"
    if file.suffix != SUFFIX:
        raise InvalidValueError(f"--out is {str(file)!r}, but it must be a file whose name ends with {SUFFIX}")
    check_out(file, out, "file")
    if out is not None and file.exists() and not _is_report(file):
        raise InvalidValueError(
            f"--out is {str(file)!r}, but that file is not an evaluation and would be lost: name another"
        )


def _is_report(file: Path) -> bool:
    try:
        contents = json.loads(file.read_bytes())
    except ValueError:
        return False
    return isinstance(contents, dict) and contents.keys() >= REPORT_KEYS
