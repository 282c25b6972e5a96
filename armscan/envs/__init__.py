"""The Gymnasium environment: actions, observations, wrappers, rendering."""

from armscan.envs.actions import COMPONENTS, PROJECTIONS, ActionBounds
from armscan.envs.env import ArmscanEnv
from armscan.envs.observations import (
    OBSERVATIONS,
    ActionRewardObservation,
    ClusterObservation,
    MergedObservation,
    Observation,
    SliceGeometry,
    View,
)
from armscan.envs.scene import RandomTransform, Scene
from armscan.envs.wrappers import BestActionMemory, make_armscan_env
from armscan.volumes.plane import ManipulatorAction

__all__ = [
    "COMPONENTS",
    "OBSERVATIONS",
    "PROJECTIONS",
    "ActionBounds",
    "ActionRewardObservation",
    "ArmscanEnv",
    "BestActionMemory",
    "ClusterObservation",
    "ManipulatorAction",
    "MergedObservation",
    "Observation",
    "RandomTransform",
    "Scene",
    "SliceGeometry",
    "View",
    "make_armscan_env",
]
