"""armscan: agents that find the carpal tunnel's plane in labelmaps of the arm, and hyperparameter sweeps over them.

Importing the package registers the environment `armscan/Armscan-v0` with Gymnasium and loads nothing else.
"""

import gymnasium

__version__ = "0.1.0"

ENV_ID = "armscan/Armscan-v0"

gymnasium.register(
    id=ENV_ID,
    entry_point="armscan.envs.factory:make_armscan_env",
    vector_entry_point="armscan.envs.factory:make_armscan_vector_env",
)
