"""Tracked runs of untrained agents, made in a moment."""

import contextlib
import json

import numpy as np
import yaml
from mlflow import MlflowClient
from omegaconf import OmegaConf

from armscan.config.compose import compose
from armscan.experiment.build import build_setup
from armscan.experiment.provenance import volume_tags
from armscan.tracking import TrackedRun
from armscan.tracking.tags import DOMAIN_TAG, VOLUMES
from armscan.training import TRAINING, TrainingDomain, save_checkpoint
from armscan.utils.files import sha256
from armscan.utils.run_files import SHA256_TAGS
from tests.support import FEW_VOLUMES
from tests.support.stores import store_in

FEW = [*FEW_VOLUMES, "env.max_steps=4"]

IMAGES = ["network.images.filters=[2,2,2]", "network.images.vector_sizes=[4]", "network.images.head_sizes=[4]"]
IMAGES += ["agent.buffer_size=500", "agent.num_envs=1", "agent.learning_starts=1"]
ON_FILES = {"few": ["data=nifti", "data.path=wrists", "env.max_steps=2"]}

GUESSER = {"_target_": "tests.support.tracked_runs.Guesser"}


class Guesser:
    """A baseline that draws random planes, algorithm and agent in one."""

    def agent(self, setup):
        self._n_action = len(setup.action_names)
        return self

    def begin(self, *, seed, bounds):
        self._rng = np.random.default_rng(seed)

    def act(self, observation, reward):
        return self._rng.uniform(-1, 1, self._n_action)


class GuesserOfAnything(Guesser):
    """The same, with any arguments."""

    def __init__(self, **_):
        pass


def tracked(folder, *overrides, agent=None, kept=("config.yaml", "volumes.json", "best.pt"), has_tag=True, few=FEW):
    """Track a run of an untrained agent, started in this folder; return its ID."""
    config = compose([*few, *overrides])
    OmegaConf.resolve(config)
    if agent:
        config.agent = agent
    with contextlib.chdir(folder):
        experiment = build_setup(config)
    client, experiment_id = store_in(folder, "armscan")
    domain = TrainingDomain.of(experiment.env_factory.make_env(experiment.split.training))
    (folder / "config.yaml").write_text(yaml.safe_dump(OmegaConf.to_container(config)))
    (folder / "volumes.json").write_text(json.dumps(experiment.split.fingerprints()))
    tags = {SHA256_TAGS[name]: sha256((folder / name).read_bytes()) for name in SHA256_TAGS if name in kept}
    # Runs without fingerprints are of earlier versions, which had the names alone in this tag.
    tags |= volume_tags(experiment) | {f"{VOLUMES}{TRAINING}": " ".join(experiment.split.training)}
    tags |= {"working_folder": str(folder)}
    tags |= {DOMAIN_TAG: domain.to_json()} if has_tag else {}
    with TrackedRun.start(client, experiment_id, name="tiny", config={}, tags=tags, folder=folder) as run:
        if agent is None:
            facts = {"n_env_steps": 7, "run_id": run.run_id}
            save_checkpoint(folder / "best.pt", experiment.agent.weights(), facts)
            run.log_model({}, n_env_steps=7)
        run.log_files(*(folder / name for name in kept if (folder / name).exists()))
    return run.run_id


def store_of(folder):
    """Return the store in a folder."""
    return MlflowClient(f"sqlite:///{folder}/mlruns.db")


def written(folder, pattern="*"):
    """Return the contents of the only evaluation in a folder."""
    (file,) = (folder / "evaluations").glob(f"{pattern}.json")
    return json.loads(file.read_text())
