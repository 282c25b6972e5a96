"""The README's pictures of a study in MLflow and in Optuna's dashboard, as a browser shows them.

    python -m benchmarks.sweeps.screenshots [FOLDER]

The study takes some minutes; it is kept in the folder (`screenshots` where none is named), and not run again. It needs
Chromium and its driver (`apt-get install chromium chromium-driver`).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from armscan.config.defaults import default_storage, default_tracking
from armscan.config.services import DASHBOARD_PORT, MLFLOW_PORT
from armscan.sweeps.storage.storage import existing_storage
from armscan.tracking.store import open_existing_store
from armscan.ui.servers import HOST, mlflow_server, start_dashboard
from tests.support.browser import chromium

PICTURES = Path(__file__).parents[2] / "docs" / "images"
STUDY = ["-m", "sweep=sac_y", "study.n_trials=24", "training.env_steps=6000", "study.final_eval.top_k=0"]
NAME, N_TRIALS, BEST = "sac_y", 24, "mean_steps"
COLUMNS = (
    *("metrics.`mean_steps`", "metrics.`success_rate`", "params.`agent.lr`", "params.`agent.gamma`"),
    *("params.`agent.utd_ratio`", "params.`agent.batch_size`"),
)
WIDTH_PX, N_COLOURS = 1400, 256


def look_at_study(address: str, file: Path) -> None:
    """Keep what the dashboard shows of the study: history, importance of each key, and when each trial ran."""
    with tempfile.TemporaryDirectory() as profile, chromium(Path(profile), width=1750, height=1180) as browser:
        browser.open(f"{address}/dashboard/studies/0")
        browser.count(".scatterlayer .points path", at_least=N_TRIALS)
        browser.click("*", text="Log y scale")
        browser.count(".barlayer .point path", at_least=4 + N_TRIALS)
        browser.keep(file)


def look_at_runs(address: str, file: Path) -> None:
    """Keep what MLflow shows of the study: its run, those of its trials below it, below the best one its training."""
    client = open_existing_store("sqlite:///mlruns.db")
    experiment = client.get_experiment_by_name("armscan")
    runs = client.search_runs([experiment.experiment_id], order_by=[f"metrics.{BEST}"])
    (study,) = [run for run in runs if run.info.run_name == f"study {NAME}"]
    best = next(run for run in runs if run.data.tags.get("mlflow.parentRunId") == study.info.run_id)
    (training,) = [run for run in runs if run.data.tags.get("mlflow.parentRunId") == best.info.run_id]
    shown = {
        "selectedColumns": COLUMNS,
        "runsExpanded": {run.info.run_id: True for run in (study, best)},
        "orderByKey": "attributes.start_time",
        "orderByAsc": False,
    }
    # Where MLflow remembers what somebody has chosen to see.
    key = f'MLflowLocalStorage-1.1-ExperimentPage-["{experiment.experiment_id}"]-ReactComponentState'
    remembered = f"localStorage.setItem({json.dumps(key)}, {json.dumps(json.dumps(shown))})"
    with tempfile.TemporaryDirectory() as profile, chromium(Path(profile), height=940) as browser:
        browser.before_each_page(remembered)
        browser.open(f"{address}/#/experiments/{experiment.experiment_id}/runs?workflowType=machine_learning")
        browser.find("a", text=training.info.run_name)
        browser.keep(file)


def make_small(file: Path) -> None:
    """Make a picture as wide and as small as a page needs it."""
    with Image.open(file) as image:
        height = round(image.height * WIDTH_PX / image.width)
        small = image.convert("RGB").resize((WIDTH_PX, height), Image.Resampling.LANCZOS)
    small.quantize(N_COLOURS).save(file, optimize=True)
    print(f"{file}: {file.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Run the study where it is not there, and keep the pictures."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "screenshots")
    folder.mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    subprocess.run([sys.executable, "-m", "armscan.run", *STUDY], check=True)
    storage = existing_storage(default_storage())
    assert storage is not None
    studies, runs = PICTURES / "ui_dashboard.png", PICTURES / "ui_mlflow.png"
    look_at_study(start_dashboard(storage, Path("optuna.artifacts"), DASHBOARD_PORT), studies)
    with mlflow_server(default_tracking()["uri"], MLFLOW_PORT):
        look_at_runs(f"http://{HOST}:{MLFLOW_PORT}", runs)
    for file in (studies, runs):
        make_small(file)


if __name__ == "__main__":
    main()
