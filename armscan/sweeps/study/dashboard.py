"""What Optuna's dashboard shows of a study beside Optuna's own: the way to MLflow, and pictures of learning curves."""

from __future__ import annotations

from pathlib import Path

import optuna
from optuna.artifacts import FileSystemArtifactStore, upload_artifact
from optuna.trial import Trial

from armscan.config.services import MLFLOW_PORT
from armscan.tracking import TrackingStore
from armscan.utils.log import log

# Where `armscan ui` serves the runs of a store that is no server.
LOCAL_UI = f"http://127.0.0.1:{MLFLOW_PORT}"


def note_run(
    target: optuna.Study | Trial, client: TrackingStore, experiment_id: str, run_id: str, folder: Path
) -> None:
    """Leave a note with the link to the tracked run of a study or a trial, and its folder.

    Args:
        target: the study, or the trial.
        client: the tracking store.
        experiment_id: the MLflow experiment of the run.
        run_id: the ID of the run.
        folder: the folder of the study or the trial.
    """
    # Deferred: it takes a second, and only who works at a study needs it.
    from optuna_dashboard import save_note

    address = client.uri.rstrip("/") if client.uri.startswith("http") else LOCAL_UI
    link = f"[its run in MLflow]({address}/#/experiments/{experiment_id}/runs/{run_id})"
    save_note(target, f"{link}, {run_id}\n\nits folder: `{folder.resolve()}`")


def show_picture(trial: Trial, picture: Path, artifacts: Path) -> None:
    """Copy a picture to where the dashboard finds those of a trial.

    Args:
        trial: which still runs.
        picture: a file.
        artifacts: folder of the pictures of all studies.
    """
    try:
        artifacts.mkdir(parents=True, exist_ok=True)
        upload_artifact(study_or_trial=trial, file_path=str(picture), artifact_store=FileSystemArtifactStore(artifacts))
    except OSError as error:
        # No reason for a trial to fail: it is in its folder, too.
        log(f"{picture} cannot be shown in Optuna's dashboard: {error}")
