"""Folders of trials, and of their trainings."""

from __future__ import annotations

from pathlib import Path

TRIAL_DIGITS = 4


def trial_folder(study_folder: Path, number: int) -> Path:
    """Return the folder of a trial."""
    return study_folder / "trials" / f"{number:0{TRIAL_DIGITS}}"


def seed_folder(folder: Path, seed: int) -> Path:
    """Return the folder of a training, in that of its trial."""
    return folder / f"seed_{seed}"


def seed_folders(folder: Path) -> list[Path]:
    """Return the folders of a trial's trainings."""
    return sorted(folder.glob("seed_*"))
