"""Trials of Hydra's own Optuna sweeper that another process trains.

The overrides of each trial go to standard output as a line of JSON, and its value comes back on standard input.
"""

from __future__ import annotations

import json
import os
import sys

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

# Hydra logs to standard output, too: redirect that to standard error.
TRIALS = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)


@hydra.main(version_base=None, config_path=None)
def main(_: DictConfig) -> float:
    """Let the other process train a trial, and return its value."""
    print(json.dumps(list(HydraConfig.get().overrides.task)), file=TRIALS, flush=True)
    return float(sys.stdin.readline())


if __name__ == "__main__":
    main()
