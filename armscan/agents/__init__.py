"""Who acts: learning algorithms through Tianshou, and their networks."""

from armscan.agents.device import checked_device
from armscan.agents.networks import MLP, Network
from armscan.agents.protocols import Agent, Learner, LearningAlgorithm, LearningSetup, VectorEnvMaker
from armscan.agents.sac import SAC

__all__ = [
    "MLP",
    "SAC",
    "Agent",
    "Learner",
    "LearningAlgorithm",
    "LearningSetup",
    "Network",
    "VectorEnvMaker",
    "checked_device",
]
