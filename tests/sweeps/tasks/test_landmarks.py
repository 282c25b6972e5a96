"""A study that trains nothing: how well clusters tell the labelled planes from the rest of the arm."""

import pytest
from omegaconf import OmegaConf

from armscan.config.compose import compose_run
from armscan.errors import InvalidValueError
from armscan.sweeps.tasks.landmarks import LandmarksTask

FEW = ["data.n_training=2", "data.n_validation=1", "data.n_test=1"]


class Trial:
    """The part of an attempt that this task uses."""

    seeds = (0,)

    def __init__(self, *overrides):
        self._words = ["sweep=landmarks", *FEW, *overrides]

    def keep_subjects(self, subjects):
        self.subjects = subjects

    def config(self, seed):
        return compose_run([*self._words, f"seed={seed}"])


def test_landmarks_of_the_published_clusters_are_there_at_labelled_planes_and_not_elsewhere():
    task, trial = LandmarksTask(), Trial()
    task.check(trial.config(0)[0])
    metrics = task.run(trial)
    assert set(metrics) == set(task.metrics(OmegaConf.create()))
    assert metrics["labelled_reward"] == metrics["worst_labelled_reward"] == 0.0
    assert metrics["elsewhere_reward"] < -0.2
    assert metrics["separation"] == pytest.approx(-metrics["elsewhere_reward"])
    assert task.final_metric in task.evaluate(trial)


def test_evaluation_has_the_metrics_of_each_test_volume():
    trial = Trial("data.n_test=2")
    figures = LandmarksTask().evaluate(trial)
    of_volumes = [value for name, value in figures.items() if name.startswith("test/volume/") and "separation" in name]
    assert len(of_volumes) == 2
    assert figures["test/separation"] == pytest.approx(sum(of_volumes) / 2)
    assert len(set(trial.subjects.values())) == len(trial.subjects) == 2


def test_landmarks_that_cannot_be_told_apart_are_worth_less():
    coarse = Trial("env.clustering.bones.eps_px=8.0", "env.clustering.tendons.eps_px=6.0")
    assert LandmarksTask().run(coarse)["separation"] < LandmarksTask().run(Trial())["separation"]


def test_reward_is_fitted_to_the_training_volumes_alone():
    task, trial = LandmarksTask(), Trial("reward=agreement")
    assert task.run(trial)["labelled_reward"] == 0.0
    # Fitted to the plane itself, it would be 0 there.
    assert task.validate(trial)["labelled_reward"] < 0.0
    assert task.evaluate(trial)["test/labelled_reward"] < 0.0


def test_landmarks_need_a_clustering_whose_parts_can_be_searched():
    with pytest.raises(InvalidValueError, match=r"env\.clustering is 'pixels', but this study searches its parts"):
        LandmarksTask().check(Trial("env.clustering=pixels").config(0)[0])
