"""What a run needs before anything is tracked: its experiment, and the environments that its agent is judged in."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from omegaconf import DictConfig

from armscan.agents import Learner
from armscan.building import Experiment, build
from armscan.mistakes import quieten_libraries
from armscan.training import Familiar, Fingerprints, Origin
from armscan.training.evaluation import Env


@dataclass(frozen=True, kw_only=True)
class Stage:
    """An experiment and the environments that its agent is judged in, made and so checked before anything is tracked.

    Args:
        experiment: what is run.
        training_env: of the training volumes, for the final evaluation.
        validation_env: for the validation after each epoch.
        test_env: for the final evaluation.
        film_env: for the film of an episode.
    """

    experiment: Experiment
    training_env: Env
    validation_env: Env
    test_env: Env
    film_env: Env

    @classmethod
    def built(cls, config: DictConfig) -> Self:
        """Builds what a configuration describes.

        Raises:
            InvalidValueError: if something in it is not allowed.
        """
        quieten_libraries()
        torch.set_num_threads(1)
        experiment = build(config)
        maker, split = experiment.maker, experiment.split
        stage = cls(
            experiment=experiment,
            training_env=maker.one(split.training),
            validation_env=maker.one(split.validation),
            test_env=maker.one(split.test),
            film_env=maker.one(split.test, render_mode="rgb_array"),
        )
        stage._check()
        return stage

    def _check(self) -> None:
        """Raises `InvalidValueError` where the agent cannot act in one of the environments that it is judged in."""
        envs = (self.training_env, self.validation_env, self.test_env)
        trained = Familiar.of(self.training_env)
        for env in envs[1:]:
            trained.check_observed(Familiar.of(env))
        if not isinstance(self.experiment.agent, Learner):
            # How many planes there are to go through depends on the sizes of the volumes.
            for bounds in {bounds for env in envs for bounds in env.get_wrapper_attr("task").bounds.values()}:
                self.experiment.agent.begin(seed=0, bounds=bounds)

    def origin(self, run_id: str) -> Origin:
        """Returns what the checkpoints of a run say that they come from."""
        return Origin(run_id=run_id, volumes=self.fingerprints)

    @cached_property
    def fingerprints(self) -> Fingerprints:
        """Of the volumes; once, because they take a second for a hundred of them."""
        return self.experiment.split.fingerprints()
