"""Who acts: learning algorithms through Tianshou, and their networks."""

from armscan.agents.device import checked_device
from armscan.agents.networks import MLP, Network
from armscan.agents.protocols import Agent, EnvMaker, Learner, LearningAlgorithm, LearningSetup
from armscan.agents.sac import SAC

__all__ = [
    "MLP",
    "SAC",
    "Agent",
    "EnvMaker",
    "Learner",
    "LearningAlgorithm",
    "LearningSetup",
    "Network",
    "checked_device",
]
