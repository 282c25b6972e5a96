"""One run: which volumes, how long to train, how to judge, what to keep."""

from armscan.files import BEST_CHECKPOINT, LAST_CHECKPOINT
from armscan.training.callbacks import Callback, EpochReport
from armscan.training.checkpoint import load_checkpoint, load_weights, save_checkpoint
from armscan.training.course import Origin, take_up
from armscan.training.data import PARTS, Split, mixed_data, nifti_data, phantom_data
from armscan.training.evaluation import TEST, TRAINING, VALIDATION, Episode, Evaluation, evaluate
from armscan.training.familiar import Familiar
from armscan.training.figures import Figures
from armscan.training.film import Film, film_episode, outcome
from armscan.training.fingerprints import Fingerprints, check_unchanged, fingerprint
from armscan.training.train import Budget, SolvedCriterion, TrainingResult, train

__all__ = [
    "BEST_CHECKPOINT",
    "LAST_CHECKPOINT",
    "PARTS",
    "TEST",
    "TRAINING",
    "VALIDATION",
    "Budget",
    "Callback",
    "Episode",
    "EpochReport",
    "Evaluation",
    "Familiar",
    "Figures",
    "Film",
    "Fingerprints",
    "Origin",
    "SolvedCriterion",
    "Split",
    "TrainingResult",
    "check_unchanged",
    "evaluate",
    "film_episode",
    "fingerprint",
    "load_checkpoint",
    "load_weights",
    "mixed_data",
    "nifti_data",
    "outcome",
    "phantom_data",
    "save_checkpoint",
    "take_up",
    "train",
]
