"""Model card of a registered policy: the metrics of its run's evaluations, as Markdown and as tags."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from armscan.config.command_hints import armscan_command
from armscan.errors import TrackingError
from armscan.evaluation import EvaluationReport
from armscan.evaluation.report import REFUSED_BY_MLFLOW, metrics_in_markdown
from armscan.tracking import EVALUATED_TAG, FoundRun
from armscan.training import Evaluation
from armscan.utils.files import EVALUATION_FILE

# What MLflow's databases take of a description.
MAX_CHARS = 5000
OWN_VOLUMES = "own volumes"
TAGGED = ("success_rate", "mean_steps", "mean_distance_mm", "mean_distance_deg", "mean_dice")


@dataclass(frozen=True)
class Card:
    """Model card of a policy.

    Args:
        text: Markdown.
        tags: figures by their names.
    """

    text: str
    tags: dict[str, str]

    @classmethod
    def of(cls, run: FoundRun, folder: Path) -> Self:
        """Return the card of a run's policy, of its own evaluation and the latest by `armscan evaluate` with a JSON.

        Args:
            run: the run.
            folder: takes the files.

        Raises:
            TrackingError: if an evaluation cannot be read.
        """
        text = f"The policy of run `{run.run_id}`, {run.name}."
        reports = _reports(run, folder)
        if not reports:
            command = armscan_command("evaluate", run.run_id, tracking=run.uri)
            text += f"\n\nNothing is known of how good it is: `{command}` says it."
        tags: dict[str, str] = {}
        for title, report in reports.items():
            section = f"\n\n### {title}\n\n{metrics_in_markdown(report.by_split)}"
            # Where there is no room for both, the run's own evaluation stays.
            if len(text + section) <= MAX_CHARS:
                text += section
            tags |= _tags(report)
        return cls(text, tags)


def _reports(run: FoundRun, folder: Path) -> dict[str, EvaluationReport]:
    """Return the evaluations of a run by their titles, its own first."""
    reports = {}
    if EVALUATION_FILE in run.files:
        reports["at the end of the run"] = _read(run, run.run_id, EVALUATION_FILE, folder)
    if (latest := _latest(run)) is not None:
        report = _read(run, *latest, folder)
        changes = "".join(f", {key}={value}" for key, value in report.facts["changes"].items())
        reports[f"by evaluation {latest[0]}, on {report.facts['data']}{changes}"] = report
    return reports


def _latest(run: FoundRun) -> tuple[str, str] | None:
    """Return the latest evaluation of a run that has kept its JSON: the id of its own run, and the file."""
    found = run.client.search_runs(
        [run.experiment_id],
        f"tags.`{EVALUATED_TAG}` = '{run.run_id}' and attributes.status = 'FINISHED'",
        order_by=["attributes.start_time DESC"],
    )
    for evaluation in found:
        for artifact in run.client.list_artifacts(evaluation.info.run_id):
            if artifact.path.endswith(".json") and not artifact.is_dir:
                return evaluation.info.run_id, artifact.path
    return None


def _read(run: FoundRun, run_id: str, file: str, folder: Path) -> EvaluationReport:
    """Return the evaluation in an artifact, of the run itself or of one by `armscan evaluate`."""
    text = Path(run.client.download_artifacts(run_id, file, str(folder))).read_bytes()
    try:
        contents = json.loads(text)
        if run_id == run.run_id:
            contents = {"episodes": {label: each["episodes"] for label, each in contents.items()}}
        facts = {key: contents[key] for key in ("data", "changes") if run_id != run.run_id}
        evaluations = {label: Evaluation.of_plain(some) for label, some in contents["episodes"].items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise _damaged(run_id, file) from error
    is_read = not facts or (isinstance(facts["data"], str) and isinstance(facts["changes"], dict))
    if not (is_read and evaluations and all(evaluation.episodes for evaluation in evaluations.values())):
        raise _damaged(run_id, file)
    return EvaluationReport(evaluations, has_total=facts.get("data", OWN_VOLUMES) != OWN_VOLUMES, facts=facts)


def _damaged(run_id: str, file: str) -> TrackingError:
    return TrackingError(f"run {run_id}: its {file} is damaged; put it back, or remove it")


def _tags(report: EvaluationReport) -> dict[str, str]:
    return {
        f"{REFUSED_BY_MLFLOW.sub('_', label.replace(' ', '_'))}/{name}": f"{estimate.value:.4g}"
        for label, figures in report.by_split.items()
        for name in TAGGED
        if (estimate := figures.estimates[name]).value == estimate.value
    }
