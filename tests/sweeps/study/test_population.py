"""The population that a study's settings describe, and the settings that are refused."""

import pytest
from omegaconf import OmegaConf

from armscan.errors import InvalidValueError
from armscan.sweeps.study.components import read_settings
from armscan.sweeps.study.population import population_of

PBT = ["sweep=pbt_sac_zy"]


def population(*words):
    settings, _, config = read_settings([*PBT, *words])
    return population_of(settings, config)


def test_sweep_describes_a_population_and_others_none():
    found = population()
    assert (found.settings.population, found.n_generations, found.n_trials) == (16, 5, 80)
    assert not found.is_maximized
    settings, _, config = read_settings(["sweep=sac_zy"])
    assert population_of(settings, config) is None


def test_any_sweep_of_what_can_change_trains_a_population_in_one_line():
    words = ["study/sampler=pbt", "study/pruner=none", "training.solved=null", "study.enqueue=[]", "study.n_trials=24"]
    settings, _, config = read_settings(["sweep=sac_y", *words])
    found = population_of(settings, config)
    assert (found.settings.population, found.n_generations) == (8, 3)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["study.n_trials=40"],
            "study.n_trials is 40, but 16 members with 5 generations (training",
        ),
        (
            ["study/pruner=median"],
            "population-based training (study/sampler=pbt) requires study/pruner=none",
        ),
        (
            ["study.objectives=[minimize mean_steps,maximize success_rate]"],
            "population-based training (study/sampler=pbt) requires one objective, but study.objectives has 2",
        ),
        (
            ["study.constraints=['env_steps <= 9']"],
            "population-based training (study/sampler=pbt) requires study.constr",
        ),
        (["study.enqueue=[default]"], "population-based training (study/sampler=pbt) requires study.enqueue=[]"),
        (["training.solved={}"], "population-based training (study/sampler=pbt) requires training.solved=null"),
        (["study.sampler.interval_env_steps=7000"], "study.sampler.interval_env_steps is 7000, but it must divide"),
        (["study.sampler.interval_env_steps=30000"], "study.sampler.interval_env_steps is 30000, but it must divide"),
        (
            ["study.sampler.interval_env_steps=2000"],
            "study.sampler.interval_env_steps is 2000, but an epoch must begin in each generation, and they begin at "
            "the environment steps 2000, 5008, 8016, 11024 and 6 more (training.eval_every_env_steps in whole "
            "collections, agent.learning_starts): give study.sampler.interval_env_steps=3000",
        ),
        (
            # Epochs of two collections, 4096 steps: none would begin in the generation from 7500.
            [
                "agent=ppo",
                "training.env_steps=20000",
                "training.eval_every_env_steps=2500",
                "study.sampler.interval_env_steps=2500",
            ],
            "study.sampler.interval_env_steps is 2500, but an epoch must begin in each generation",
        ),
        (
            # The steps before learning starts fill the first generation.
            ["agent.learning_starts=6000", "training.eval_every_env_steps=100"],
            "study.sampler.interval_env_steps is 6000, but an epoch must begin in each generation",
        ),
        (
            ["+study.space={stack:{choices:[1,2]}}"],
            "study.space has stack, but during a training only this can change: agent.lr, agent.lr_end_factor,",
        ),
        (["study.sampler.population=1"], "study.sampler cannot be made: study.sampler.population is 1, but it must be"),
        (["study.sampler.quantile=0.6"], "study.sampler cannot be made: study.sampler.quantile is 0.6, but it must be"),
    ],
)
def test_population_answers_mistakes_in_one_line(words, line):
    with pytest.raises(InvalidValueError) as raised:
        population(*words)
    assert str(raised.value).startswith(line)


def test_agent_that_cannot_change_is_refused():
    settings, _, config = read_settings(PBT)
    OmegaConf.set_struct(config, False)
    config.agent = {"_target_": "armscan.agents.Random"}
    with pytest.raises(InvalidValueError, match=r"study\.space has agent\.lr, but during a training only"):
        population_of(settings, config)
