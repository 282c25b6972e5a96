"""Agents: learning algorithms with their networks, and baselines to compare them with."""

from armscan.agents.baselines import Exhaustive, Random
from armscan.agents.compute import Compute
from armscan.agents.multimodal import Multimodal
from armscan.agents.networks import MLP, Network, NetworkByObservation, NetworkChoice
from armscan.agents.optuna_search import OptunaSearch
from armscan.agents.plane_finder import PlaneFinder
from armscan.agents.ppo import PPO
from armscan.agents.protocols import Agent, AgentSetup, Algorithm, Learner, VectorEnvFactory
from armscan.agents.regression import Regression
from armscan.agents.residual_sac import ResidualSAC
from armscan.agents.sac import SAC
from armscan.agents.schedule import Segment, scheduled_algorithms
from armscan.agents.scheduled_learner import ScheduledLearner

__all__ = [
    "MLP",
    "PPO",
    "SAC",
    "Agent",
    "AgentSetup",
    "Algorithm",
    "Compute",
    "Exhaustive",
    "Learner",
    "Multimodal",
    "Network",
    "NetworkByObservation",
    "NetworkChoice",
    "OptunaSearch",
    "PlaneFinder",
    "Random",
    "Regression",
    "ResidualSAC",
    "ScheduledLearner",
    "Segment",
    "VectorEnvFactory",
    "scheduled_algorithms",
]
