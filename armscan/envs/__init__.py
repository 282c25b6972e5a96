"""The Gymnasium environment: actions, observations, wrappers, its vector form, rendering."""

from armscan.envs.actions import COMPONENTS, PROJECTIONS, ActionBounds
from armscan.envs.env import ArmscanEnv
from armscan.envs.factory import EnvFactory, make_armscan_env, make_armscan_vector_env
from armscan.envs.metric_slice import MetricSliceObservation
from armscan.envs.observation_registry import MergedObservation
from armscan.envs.observations import ActionRewardObservation, ClusterObservation, Observation, SliceGeometry, View
from armscan.envs.scene import RandomTransform, Scene
from armscan.envs.slice_observations import SliceChannelsObservation, SliceObservation
from armscan.envs.spaces import MultiBoxSpace
from armscan.envs.vector_env import ArmscanVectorEnv
from armscan.envs.wrappers import BestActionMemory, FrameStack, VectorBestActionMemory, VectorFrameStack
from armscan.volumes.plane import ManipulatorAction

__all__ = [
    "COMPONENTS",
    "PROJECTIONS",
    "ActionBounds",
    "ActionRewardObservation",
    "ArmscanEnv",
    "ArmscanVectorEnv",
    "BestActionMemory",
    "ClusterObservation",
    "EnvFactory",
    "FrameStack",
    "ManipulatorAction",
    "MergedObservation",
    "MetricSliceObservation",
    "MultiBoxSpace",
    "Observation",
    "RandomTransform",
    "Scene",
    "SliceChannelsObservation",
    "SliceGeometry",
    "SliceObservation",
    "VectorBestActionMemory",
    "VectorFrameStack",
    "View",
    "make_armscan_env",
    "make_armscan_vector_env",
]
