"""Model card of a registered policy: the metrics of its run's evaluations, as Markdown and as tags."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import Any, Self

from armscan.config.command_hints import armscan_command
from armscan.errors import TrackingError
from armscan.evaluation import EvaluationReport
from armscan.evaluation.report import TOTAL, assigned
from armscan.tracking import FoundRun
from armscan.tracking.sanitize import name_of
from armscan.tracking.tags import EVALUATED_TAG
from armscan.training import ON_PLANE, TEST, Evaluation, ResultTable
from armscan.training.episode_results import metric_prefix
from armscan.training.metric_display import LEADING
from armscan.utils.run_files import BASELINES_FILE, EVALUATION_FILE, is_as_tagged

# Longest description that MLflow's databases accept.
MAX_CHARS = 5000
# Longest note of it; notes with the names of many volumes are cut.
MAX_NOTE_CHARS = 300
TAGGED = (*LEADING, "mean_distance_mm", "mean_distance_deg", "mean_dice")


@dataclass(frozen=True)
class Card:
    """Model card of a policy.

    Args:
        text: Text of the card, in Markdown.
        tags: Metrics by name, for the version's tags.
    """

    text: str
    tags: dict[str, str]

    @classmethod
    def of(cls, run: FoundRun, folder: Path, differs: str | None = None) -> Self:
        """Return the card of a run's policy, from its own evaluation and the latest `armscan evaluate` with a JSON.

        Args:
            run: Run to describe.
            folder: Folder for the downloaded files.
            differs: How the policy differs from the agent that was evaluated. Default: None, it does not.

        Raises:
            TrackingError: If an evaluation cannot be read.
        """
        text = f"The policy of run `{run.run_id}`, {_shortened(run.name)}."
        text += f"\n\nNote: this policy has not been evaluated; {_shortened(differs)}." if differs else ""
        reports = _reports(run, folder)
        if not reports and not differs:
            command = armscan_command("evaluate", run.run_id, tracking=run.uri, trust=run.needs_trust)
            text += f"\n\nNot evaluated yet: run `{command}`."
        tags: dict[str, str] = {}
        for title, report in reports.items():
            label = _label(report)
            noted = (*report.facts.get("notes", ()), *report.notes(label))
            notes = "".join(f"\n\nNote: {_shortened(note)}." for note in noted)
            result = report.tables()[label].headline
            section = f"\n\n### {title}\n\n{result}\n\n{_table(report).markdown()}{notes}"
            left_out = f"\n\nLeft out, because it is too long: {_shortened(title)}."
            # If there is no room for both, the run's own evaluation stays.
            text += next(part for part in (section, left_out, "") if len(text + part) <= MAX_CHARS)
            # Tags cannot say that rules were changed: all are from the first evaluation without changes.
            tags = tags or ({} if report.facts.get("changes") else _tags(report))
        return cls(text, tags)


def _shortened(text: str) -> str:
    """Return a text in one line, so that it cannot add headings to the card, and not too long for it."""
    return shorten(text, MAX_NOTE_CHARS, placeholder=" …")


def _reports(run: FoundRun, folder: Path) -> dict[str, EvaluationReport]:
    """Return the evaluations of a run by their titles, its own first."""
    reports = {}
    if EVALUATION_FILE in run.files:
        reports["at the end of the run"] = _read(run, run.run_id, EVALUATION_FILE, folder)
    has_own = bool(reports)
    for position, (run_id, file) in enumerate(_evaluated(run)):
        report = _read(run, run_id, file, folder)
        changes = report.facts["changes"]
        # The latest one and, if the run has no evaluation of its own, the latest by its rules.
        if position == 0 or not changes:
            title = f"by evaluation {run_id}, on {report.facts['data']}"
            reports[", ".join([title, *assigned(changes)])] = report
        if has_own or not changes:
            break
    return reports


def _evaluated(run: FoundRun) -> Iterator[tuple[str, str]]:
    """Yield the evaluations of a run that kept their JSON, the latest first: MLflow run ID, and file."""
    found = run.store.search_runs(
        [run.experiment_id],
        f"tags.`{EVALUATED_TAG}` = '{run.run_id}' and attributes.status = 'FINISHED'",
        order_by=["attributes.start_time DESC"],
    )
    for evaluation in found:
        for artifact in run.store.list_artifacts(evaluation.info.run_id):
            if artifact.path.endswith(".json") and not artifact.is_dir:
                yield evaluation.info.run_id, artifact.path
                break


def _read(run: FoundRun, run_id: str, file: str, folder: Path) -> EvaluationReport:
    """Return the evaluation in an artifact, of the run itself or of one by `armscan evaluate`."""
    contents = _json(run, run_id, file, folder)
    try:
        if run_id == run.run_id:
            facts = {}
            evaluations = {label: Evaluation.of_dict(each) for label, each in contents.items()}
            baselines = _own_baselines(run, folder)
        else:
            facts = {"data": contents["data"], "changes": contents["changes"], "notes": contents.get("notes", [])}
            limits = contents.get("on_plane", ON_PLANE)
            evaluations = _evaluations(contents["episodes"], limits)
            kept = contents.get("baselines", {})
            baselines = {name: _evaluations(each["episodes"], limits) for name, each in kept.items()}
        has_total = TOTAL in contents.get("splits", ())
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise _damaged(run_id, file) from error
    kinds = {"data": str, "changes": dict, "notes": list}
    is_read = all(isinstance(value, kinds[key]) for key, value in facts.items())
    played = [*evaluations.values(), *(each for by_label in baselines.values() for each in by_label.values())]
    if not (is_read and evaluations and all(evaluation.episodes for evaluation in played)):
        raise _damaged(run_id, file)
    return EvaluationReport(evaluations, has_total=has_total, facts=facts, baselines=baselines)


def _own_baselines(run: FoundRun, folder: Path) -> dict[str, dict[str, Evaluation]]:
    """Return the baselines that a run has kept, on its test volumes; none for older runs."""
    if BASELINES_FILE not in run.files:
        return {}
    contents = _json(run, run.run_id, BASELINES_FILE, folder)
    return {name: {TEST: Evaluation.of_dict(each)} for name, each in contents.items()}


def _json(run: FoundRun, run_id: str, file: str, folder: Path) -> Any:
    text = Path(run.store.download_artifacts(run_id, file, str(folder))).read_bytes()
    if run_id == run.run_id and not is_as_tagged(file, text, run.tags):
        raise _damaged(run_id, file)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _damaged(run_id, file) from error


def _evaluations(episodes: Mapping[str, object], limits: object) -> dict[str, Evaluation]:
    return {label: Evaluation.of_plain(some, limits) for label, some in episodes.items()}


def _table(report: EvaluationReport) -> ResultTable:
    """Return the agent on all volumes, and the baselines on those of `_label`."""
    figures, label = dict(report.by_split), _label(report)
    baselines = {name: each[label] for name, each in report.baselines_by_split.items() if label in each}
    return ResultTable({**figures, **{f"{name}, {label}": each for name, each in baselines.items()}})


def _label(report: EvaluationReport) -> str:
    """Return the name of the volumes that count: the test volumes, or all of a folder."""
    return TEST if TEST in report.by_split else list(report.by_split)[-1]


def _damaged(run_id: str, file: str) -> TrackingError:
    return TrackingError(f"run {run_id}: its {file} is damaged; put it back, or remove it")


def _tags(report: EvaluationReport) -> dict[str, str]:
    return {
        name_of(f"{metric_prefix(label)}/{name}"): f"{estimate.value:.4g}"
        for label, figures in report.by_split.items()
        for name in (*(limits.metric for limits in figures.on_plane), *TAGGED)
        if (estimate := figures.estimates[name]).value == estimate.value
    }
