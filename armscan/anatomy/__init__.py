"""What is seen in a slice: tissues, their clusters, and the reward computed from them."""

from armscan.anatomy.landmarks import PUBLISHED_TARGETS, Clusters, TissueClusters, checked_targets, landmark_reward
from armscan.anatomy.optimum import FoundPlane, find_optimal_plane
from armscan.anatomy.tissues import ARTERY, BONES, TENDONS, TISSUES, USUAL_PIXEL_MM, Tissue

__all__ = [
    "ARTERY",
    "BONES",
    "PUBLISHED_TARGETS",
    "TENDONS",
    "TISSUES",
    "USUAL_PIXEL_MM",
    "Clusters",
    "FoundPlane",
    "Tissue",
    "TissueClusters",
    "checked_targets",
    "find_optimal_plane",
    "landmark_reward",
]
