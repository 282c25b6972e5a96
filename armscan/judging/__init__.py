"""One evaluation: which agent, on which volumes, how it is applied to them, and what comes of it."""

from armscan.judging.report import Judgement, judgement_tables
from armscan.judging.subject import Subject, subject_of_run, subject_of_words
from armscan.judging.trial import Trial, prepare
from armscan.judging.volumes import TrainingVolumes, data_name, known_volumes, own_split, volume_groups
from armscan.training import PARTS

__all__ = [
    "PARTS",
    "Judgement",
    "Subject",
    "TrainingVolumes",
    "Trial",
    "data_name",
    "judgement_tables",
    "known_volumes",
    "own_split",
    "prepare",
    "subject_of_run",
    "subject_of_words",
    "volume_groups",
]
