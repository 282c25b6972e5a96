"""Setup of a run before tracking starts: its experiment and the environments of its evaluations."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from omegaconf import DictConfig

from armscan.agents import Learner
from armscan.experiment.build import Experiment, build_experiment
from armscan.training import CheckpointProvenance, Fingerprints, TrainingDomain
from armscan.training.rollout import Env
from armscan.utils.log import silence_library_warnings


@dataclass(frozen=True, kw_only=True)
class RunSetup:
    """An experiment and the environments of its evaluations, built and checked before tracking starts.

    Args:
        experiment: what is run.
        training_env: of the training volumes, for the final evaluation.
        validation_env: for the validation after each epoch.
        test_env: for the final evaluation.
        video_env: for the video of an episode.
    """

    experiment: Experiment
    training_env: Env
    validation_env: Env
    test_env: Env
    video_env: Env

    @classmethod
    def build(cls, config: DictConfig) -> Self:
        """Build what a configuration describes.

        Raises:
            InvalidValueError: if something in it is not allowed.
        """
        silence_library_warnings()
        torch.set_num_threads(1)
        experiment = build_experiment(config)
        maker, split = experiment.maker, experiment.split
        setup = cls(
            experiment=experiment,
            training_env=maker.one(split.training),
            validation_env=maker.one(split.validation),
            test_env=maker.one(split.test),
            video_env=maker.one(split.test, render_mode="rgb_array"),
        )
        setup._check()
        return setup

    def _check(self) -> None:
        """Raise `InvalidValueError` where the agent cannot act in one of the environments of the evaluations."""
        envs = (self.training_env, self.validation_env, self.test_env)
        trained = TrainingDomain.of(self.training_env)
        for env in envs[1:]:
            trained.check_observed(TrainingDomain.of(env))
        if not isinstance(self.experiment.agent, Learner):
            # How many planes there are to go through depends on the sizes of the volumes.
            for bounds in {bounds for env in envs for bounds in env.get_wrapper_attr("rules").bounds.values()}:
                self.experiment.agent.begin(seed=0, bounds=bounds)

    def provenance(self, run_id: str) -> CheckpointProvenance:
        """Return the provenance written into the checkpoints of a run."""
        return CheckpointProvenance(run_id=run_id, volumes=self.fingerprints)

    @cached_property
    def fingerprints(self) -> Fingerprints:
        """Of the volumes; once, because they take a second for a hundred of them."""
        return self.experiment.split.fingerprints()
