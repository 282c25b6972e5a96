"""Training: splits, episodes and their metrics, checkpoints, callbacks, progress, video."""

from armscan.stats.on_plane import ON_PLANE, OnPlane, check_on_plane
from armscan.training.baselines import evaluate_baselines
from armscan.training.callbacks import Callback, EpochReport
from armscan.training.checkpoint_file import load_checkpoint, load_weights, save_checkpoint
from armscan.training.checkpoints import CheckpointProvenance, resume_from_checkpoint, take_over_checkpoints
from armscan.training.domain import TrainingDomain
from armscan.training.episode_results import TEST, TRAINING, VALIDATION, EpisodeResult, Evaluation
from armscan.training.episodes import evaluate
from armscan.training.fingerprints import Fingerprints, check_unchanged, fingerprints_in
from armscan.training.metrics import MetricEstimates
from armscan.training.result_table import ResultTable
from armscan.training.splits import PARTS, Split, mixed_data, nifti_data, phantom_data
from armscan.training.train import Budget, SolvedCriterion, TrainingResult, train
from armscan.training.video import VideoRecorder, outcome, record_episode
from armscan.utils.run_files import BEST_CHECKPOINT, LAST_CHECKPOINT

__all__ = [
    "BEST_CHECKPOINT",
    "LAST_CHECKPOINT",
    "ON_PLANE",
    "PARTS",
    "TEST",
    "TRAINING",
    "VALIDATION",
    "Budget",
    "Callback",
    "CheckpointProvenance",
    "EpisodeResult",
    "EpochReport",
    "Evaluation",
    "Fingerprints",
    "MetricEstimates",
    "OnPlane",
    "ResultTable",
    "SolvedCriterion",
    "Split",
    "TrainingDomain",
    "TrainingResult",
    "VideoRecorder",
    "check_on_plane",
    "check_unchanged",
    "evaluate",
    "evaluate_baselines",
    "fingerprints_in",
    "load_checkpoint",
    "load_weights",
    "mixed_data",
    "nifti_data",
    "outcome",
    "phantom_data",
    "record_episode",
    "resume_from_checkpoint",
    "save_checkpoint",
    "take_over_checkpoints",
    "train",
]
