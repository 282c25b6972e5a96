"""The trials of `benchmarks.sweeps.sleeping`, run by Hydra's own Optuna sweeper in its own virtual environment."""

from __future__ import annotations

import json
import os
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from benchmarks.sweeps.wait import WAITED_FILE, wait


@hydra.main(config_path=".", config_name="config")
def main(config: DictConfig) -> float:
    """Wait as long as the trial with this number does on every platform; return `lr` as its value."""
    hydra_config = HydraConfig.get()
    waited = wait(int(hydra_config.job.num), config.shortest_s, config.longest_s)
    left = {"worker": str(os.getpid()), "waited": waited}
    (Path(hydra_config.runtime.output_dir) / WAITED_FILE).write_text(json.dumps(left))
    return float(config.lr)


if __name__ == "__main__":
    main()
