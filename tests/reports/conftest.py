"""Real tracked runs of two agents with three seeds each, made once, and invented trainings."""

import csv
import sys
from functools import partial

import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra
from mlflow import MlflowClient

from armscan import run
from armscan.reports.load import Series, TrackedTraining
from armscan.training import Evaluation
from tests.training.test_train import episode_of

SMALL = [
    *("data.n_training=1", "data.n_validation=1", "data.n_test=2", "training.env_steps=400", "env.max_steps=6"),
    *(
        "training.eval_every_env_steps=100",
        "training.validation_episodes=2",
        "evaluation.episodes=6",
        "tracking.policy=false",
    ),
    *("agent.num_envs=4", "agent.batch_size=16", "network=mlp", "network.hidden_sizes=[8]"),
]
AGENTS = {"sac": "agent.learning_starts=60", "ppo": "agent.env_steps_per_collection=100"}
# Names of their groups in reports.
GROUPS = {agent: f"agent={agent}, {key}" for agent, key in AGENTS.items()}


class Runs:
    """A store with runs in it."""

    def __init__(self, folder):
        self.folder, self.uri = folder, f"sqlite:///{folder}/mlruns.db"
        self.client = MlflowClient(self.uri)
        self.all = self.client.search_runs(["1"], order_by=["attributes.start_time ASC"])

    def ids(self, agent):
        return [each.info.run_id for each in self.all if each.data.tags["choice.agent"] == agent]

    def made(self, name="made", parent=None, **tags):
        """Make a run with nothing but tags; return its ID."""
        made = self.client.create_run(
            "1", run_name=name, tags=tags | ({"mlflow.parentRunId": parent} if parent else {})
        )
        return made.info.run_id


@pytest.fixture(scope="session")
def runs(tmp_path_factory):
    """Six runs of armscan.run, as users make them; a test that changes one restores it."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for agent, key in AGENTS.items():
            for seed in range(3):
                patch.setattr(sys, "argv", ["armscan.run", f"agent={agent}", f"seed={seed}", key, *SMALL])
                # The command sets it, and would take it for the user's setting the next time.
                patch.setenv("HYDRA_FULL_ERROR", "0")
                GlobalHydra.instance().clear()
                assert run.main() == 0
    return Runs(folder)


@pytest.fixture
def answer(armscan, runs, monkeypatch):
    """Run `armscan report` in an empty folder; return its exit code and what it printed."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", runs.uri)
    return partial(armscan, "report")


@pytest.fixture
def make_training():
    """Invent a training."""

    def make(seed=0, *, params=None, choices=None, steps=(100, 200), values=(0.0, 1.0), mean_steps=3, **changes):
        series = Series(np.array(steps, float), np.array(steps, float) / 50, np.array(values, float))
        facts = {
            "run_id": f"{seed:032x}",
            "name": f"sac-seed{seed}",
            "status": "finished",
            "started_ms": seed,
            "is_whole": True,
            "params": {"seed": str(seed)} | (params or {}),
            "choices": choices or {"agent": "sac"},
            "series": {"validation/success_rate": series, "validation/mean_steps": series} if len(steps) else {},
            "evaluation": Evaluation(tuple(make_episode(f"v{i % 2}", mean_steps) for i in range(4))),
            "volumes": {"training": {}, "test": {"v0": "a", "v1": "b"}},
            "video": b"GIF89a",
        }
        return TrackedTraining(**facts | changes)

    return make


def rows(file):
    """Return the rows of a CSV file."""
    with file.open(newline="") as opened:
        return list(csv.DictReader(opened))


def make_episode(volume, n_steps):
    return episode_of(n_steps, volume=volume, distance_mm=float(n_steps), distance_deg=0.0)
