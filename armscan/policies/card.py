"""What is told of a registered policy: the figures of its run's evaluations, as Markdown and as tags."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from armscan.errors import TrackingError
from armscan.files import EVALUATION_FILE
from armscan.judging import Judgement
from armscan.judging.report import REFUSED_BY_MLFLOW, figures_in_markdown
from armscan.settings import evaluate_command
from armscan.tracking import EVALUATED_TAG, FoundRun
from armscan.training import Evaluation
from armscan.training.evaluation import Episode

# What MLflow's databases take of a description.
MAX_CHARS = 5000
TAGGED = ("success_rate", "mean_steps", "mean_distance_mm", "mean_distance_deg", "mean_dice")


@dataclass(frozen=True)
class Card:
    """What is told of a policy.

    Args:
        text: in Markdown.
        tags: figures by their names.
    """

    text: str
    tags: dict[str, str]

    @classmethod
    def of(cls, run: FoundRun, folder: Path) -> Self:
        """Returns the card of a run's policy: of the run's own evaluation, and of the latest by `armscan.evaluate`.

        Args:
            run: the run.
            folder: takes the files.

        Raises:
            TrackingError: if an evaluation cannot be read.
        """
        text = f"The policy of run `{run.run_id}`, {run.name}."
        judgements = _judgements(run, folder)
        if not judgements:
            text += f"\n\nNothing is known of how good it is: `{evaluate_command(run.run_id, run.uri)}` says it."
        tags: dict[str, str] = {}
        for title, judgement in judgements.items():
            section = f"\n\n### {title}\n\n{figures_in_markdown(judgement.figures)}"
            # Where there is no room for both, the run's own evaluation stays.
            if len(text + section) <= MAX_CHARS:
                text += section
            tags |= _tags(judgement)
        return cls(text, tags)


def _judgements(run: FoundRun, folder: Path) -> dict[str, Judgement]:
    """Returns the evaluations of a run by their titles, its own first."""
    judgements = {}
    if EVALUATION_FILE in run.files:
        own = {label: each["episodes"] for label, each in _read(run, run.run_id, EVALUATION_FILE, folder).items()}
        judgements["at the end of the run"] = _judgement(own, run.run_id, has_total=False)
    found = run.client.search_runs(
        [run.experiment_id],
        f"tags.`{EVALUATED_TAG}` = '{run.run_id}' and attributes.status = 'FINISHED'",
        order_by=["attributes.start_time DESC"],
        max_results=1,
    )
    for evaluation in found:
        run_id = evaluation.info.run_id
        files = [artifact.path for artifact in run.client.list_artifacts(run_id) if artifact.path.endswith(".json")]
        for file in files[:1]:
            facts = _read(run, run_id, file, folder)
            changes = "".join(f", {key}={value}" for key, value in facts["changes"].items())
            judgements[f"by evaluation {run_id}, on {facts['data']}{changes}"] = _judgement(
                facts["episodes"], run_id, has_total=facts["data"] != "own volumes"
            )
    return judgements


def _read(run: FoundRun, run_id: str, file: str, folder: Path) -> dict[str, Any]:
    try:
        contents = json.loads(Path(run.client.download_artifacts(run_id, file, str(folder))).read_bytes())
    except ValueError as error:
        raise TrackingError(f"run {run_id}: its {file} is damaged") from error
    if not isinstance(contents, dict):
        raise TrackingError(f"run {run_id}: its {file} holds no evaluation")
    return contents


def _judgement(episodes: Mapping[str, Any], run_id: str, *, has_total: bool) -> Judgement:
    try:
        evaluations = {label: Evaluation(tuple(Episode(**each) for each in some)) for label, some in episodes.items()}
    except TypeError as error:
        raise TrackingError(f"run {run_id}: its evaluation is none that this version of armscan reads") from error
    return Judgement(evaluations, has_total=has_total, facts={})


def _tags(judgement: Judgement) -> dict[str, str]:
    return {
        f"{REFUSED_BY_MLFLOW.sub('_', label.replace(' ', '_'))}/{name}": f"{estimate.value:.4g}"
        for label, figures in judgement.figures.items()
        for name in TAGGED
        if (estimate := figures.estimates[name]).value == estimate.value
    }
