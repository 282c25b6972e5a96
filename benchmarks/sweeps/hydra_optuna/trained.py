"""Trials that another process trains, run by Hydra's own Optuna sweeper in an environment of its own.

The overrides of each trial go to standard output, a line of JSON each, and its value comes back on standard input.
"""

from __future__ import annotations

import json
import os
import sys

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

# Hydra logs on standard output, too: from here on that goes to standard error.
TRIALS = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)


@hydra.main(version_base=None, config_path=None)
def main(_: DictConfig) -> float:
    """Have a trial trained, and return its value."""
    print(json.dumps(list(HydraConfig.get().overrides.task)), file=TRIALS, flush=True)
    return float(sys.stdin.readline())


if __name__ == "__main__":
    main()
