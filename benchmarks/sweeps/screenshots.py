"""Take screenshots of a study in MLflow and in Optuna Dashboard.

    python -m benchmarks.sweeps.screenshots [FOLDER]

The study takes a few minutes; it is kept in the folder (default: `screenshots`) and not repeated. Needs Chromium and
its driver (`apt-get install chromium chromium-driver`).
"""

from __future__ import annotations

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
from armscan.ui.runs_page import runs_page
from armscan.ui.servers import HOST, mlflow_server, start_dashboard
from benchmarks.arguments import parser_of, run_script
from benchmarks.repository import PICTURES
from tests.support.browser import chromium

STUDY = (
    *("-m", "sweep=sac_y", "study.n_trials=24", "training.env_steps=6000", "study.workers=1"),
    *("study.final_eval.top_k=1", "study.final_eval.mean_seeds=2", "study.final_eval.test_seeds=3"),
)
NAME, N_TRIALS = "sac_y", 24
WIDTH_PX, N_COLOURS = 1400, 256


def look_at_study(address: str, file: Path) -> None:
    """Save a screenshot of the study in the dashboard: history, importance of each key, and timeline."""
    with tempfile.TemporaryDirectory() as profile, chromium(Path(profile), width=1750, height=1180) as browser:
        browser.open(f"{address}/dashboard/studies/0")
        browser.count(".scatterlayer .points path", at_least=N_TRIALS)
        browser.click("*", text="Log y scale")
        browser.count(".barlayer .point path", at_least=4 + N_TRIALS)
        browser.keep(file)


def look_at_runs(address: str, file: Path) -> None:
    """Save a screenshot of the MLflow page that `armscan ui` prints: the study's run, its trials' runs below it."""
    client = open_existing_store("sqlite:///mlruns.db")
    experiment = client.get_experiment_by_name("armscan")
    (study,) = client.search_runs([experiment.experiment_id], f"attributes.run_name = 'study {NAME}'")
    with tempfile.TemporaryDirectory() as profile, chromium(Path(profile), width=1750, height=940) as browser:
        browser.open(runs_page(address))
        browser.click(f'[row-id="{study.info.run_id}"] button')
        browser.find("a", text=f"{NAME}-{N_TRIALS - 1:04d} (pruned)")
        browser.keep(file)


def make_small(file: Path) -> None:
    """Scale a picture to the width of a page, and reduce its colours."""
    with Image.open(file) as image:
        height = round(image.height * WIDTH_PX / image.width)
        small = image.convert("RGB").resize((WIDTH_PX, height), Image.Resampling.LANCZOS)
    small.quantize(N_COLOURS).save(file, optimize=True)
    print(f"{file}: {file.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Run the study unless it is finished, and save the pictures."""
    parser = parser_of(__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("screenshots"), help="default: %(default)s")
    folder = parser.parse_args().folder
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
    run_script(main)
