"""Tissues in a slice, their clusters, and the rewards computed from them."""

from armscan.anatomy.landmarks import Clusters, Landmarks, TissueClusters, nerve_area_error, tissue_dice
from armscan.anatomy.plane_search import FoundPlane, PlaneScorer, find_optimal_plane
from armscan.anatomy.rewards import (
    PUBLISHED_TARGETS,
    SUCCESS_THRESHOLD,
    AgreementReward,
    LandmarkReward,
    Reward,
    check_targets,
    fitted_reward,
    landmark_reward,
)
from armscan.anatomy.scanner import Scanner
from armscan.anatomy.tissues import (
    METRIC_TISSUES,
    PIXEL_TISSUES,
    USUAL_PIXEL_MM,
    MetricTissue,
    PixelTissue,
    Tissue,
    Tissues,
    check_tissues,
    is_coarse,
)

__all__ = [
    "METRIC_TISSUES",
    "PIXEL_TISSUES",
    "PUBLISHED_TARGETS",
    "SUCCESS_THRESHOLD",
    "USUAL_PIXEL_MM",
    "AgreementReward",
    "Clusters",
    "FoundPlane",
    "LandmarkReward",
    "Landmarks",
    "MetricTissue",
    "PixelTissue",
    "PlaneScorer",
    "Reward",
    "Scanner",
    "Tissue",
    "TissueClusters",
    "Tissues",
    "check_targets",
    "check_tissues",
    "find_optimal_plane",
    "fitted_reward",
    "is_coarse",
    "landmark_reward",
    "nerve_area_error",
    "tissue_dice",
]
