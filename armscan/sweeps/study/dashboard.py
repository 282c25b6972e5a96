"""Notes, metrics and pictures of a study and its trials in Optuna's dashboard."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import optuna
from optuna.trial import Trial

from armscan.config.services import MLFLOW_PORT
from armscan.sweeps.scheduling.state import metrics_of_test
from armscan.sweeps.storage.attribute_names import NOTE_SUM
from armscan.tracking import TrackingStore
from armscan.training.episode_results import TEST_METRICS
from armscan.training.metric_display import COSTS, leading_among, title_of, value_text
from armscan.training.metrics import SEEDS
from armscan.utils.files import sha256
from armscan.utils.log import log
from armscan.utils.text import MISSING, markdown_table

# Where `armscan ui` serves the runs of a local store, unless it is given another port.
LOCAL_UI = f"http://127.0.0.1:{MLFLOW_PORT}"


def note_run(
    target: optuna.Study | Trial,
    store: TrackingStore,
    experiment_id: str,
    run_id: str,
    folder: Path,
    text: str = "",
) -> None:
    """Write the note of a study or a trial: a link to its tracked run, its folder, and its metrics.

    A study's note that a person has edited stays as it is.

    Args:
        target: Study or trial that gets the note.
        store: Tracking store.
        experiment_id: MLflow experiment ID of the run.
        run_id: MLflow run ID.
        folder: The folder of the study or the trial.
        text: Markdown below the link and the folder, such as the metrics. Default: "", none.
    """
    # Deferred: it takes a second, and only workers and launchers need it.
    from optuna_dashboard import get_note, save_note

    address = store.uri.rstrip("/") if store.uri.startswith("http") else LOCAL_UI
    link = f"[its run in MLflow]({address}/#/experiments/{experiment_id}/runs/{run_id})"
    begun = f"{link}, {run_id}\n\nits folder: `{folder.resolve()}`"
    note = f"{begun}\n\n{text}" if text else begun
    if isinstance(target, optuna.Study):
        left = target.user_attrs.get(NOTE_SUM, sha256(begun.encode()))
        if (known := get_note(target)) and sha256(known.encode()) != left:
            return
        target.set_user_attr(NOTE_SUM, sha256(note.encode()))
    save_note(target, note)


def table_of_seeds(of_seeds: Mapping[int, Mapping[str, float]]) -> str:
    """Return the leading metrics of seeds as a table in Markdown, a column for each seed."""
    known = next(iter(of_seeds.values()))
    names = [*leading_among(known), *(name for name in COSTS if name in known)]
    rows = []
    for name in names:
        values = (metrics.get(name, math.nan) for metrics in of_seeds.values())
        rows.append([title_of(name), *(MISSING if math.isnan(value) else value_text(name, value) for value in values)])
    return markdown_table(["validation volumes; cost in all", *(f"seed {seed}" for seed in of_seeds)], rows)


def shown_metrics(metrics: Mapping[str, float], n_seeds: int) -> dict[str, float]:
    """Return the leading metrics of a trial, rounded and by their titles, as user attributes.

    Args:
        metrics: Metrics by name; of a final training on the test volumes, only the metrics there are shown.
        n_seeds: Number of seeds that their interquartile means are over.
    """
    tested = metrics_of_test(metrics)
    of, statistic = "test volumes: " if tested else "", f" (IQM of {n_seeds} seeds)" if n_seeds > 1 else ""
    chosen = tested or metrics
    names = [name for name in leading_among(chosen) if math.isfinite(chosen[name])]
    return {f"{of}{title_of(name)}{statistic}": float(f"{chosen[name]:.4g}") for name in names}


def named_as_of_runs(metrics: Mapping[str, float], n_seeds: int, prefix: str) -> dict[str, float]:
    """Return a trial's leading metrics by the names that runs use, so that MLflow shows them in the same columns.

    Args:
        metrics: Metrics of the trial, those on the test volumes by names of their own.
        n_seeds: Number of its seeds.
        prefix: Prefix of the metrics on the validation volumes: `selection/`, or `validation/` in a population, whose
            trials play no new episodes.
    """
    of_phases = {prefix: metrics, f"{TEST_METRICS}/": metrics_of_test(metrics)}
    named = {f"{of}{name}": each[name] for of, each in of_phases.items() for name in leading_among(each)}
    return named | ({f"{prefix}{SEEDS}": float(n_seeds)} if n_seeds > 1 and metrics else {})


def show_picture(trial: Trial, picture: Path, artifacts: Path) -> None:
    """Store a picture where the dashboard finds those of a trial."""
    # Deferred: it loads boto3 if that is installed.
    from optuna.artifacts import FileSystemArtifactStore, upload_artifact

    try:
        artifacts.mkdir(parents=True, exist_ok=True)
        upload_artifact(study_or_trial=trial, file_path=str(picture), artifact_store=FileSystemArtifactStore(artifacts))
    except OSError as error:
        # No reason for a trial to fail: the picture is in its folder, too.
        log(f"{picture} cannot be shown in Optuna's dashboard: {error}")
