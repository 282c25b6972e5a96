"""Order, checkpoints and values of the members of a population: whole studies, simulated without training."""

import random
from itertools import pairwise

import numpy as np
import optuna
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import TrialState

from armscan.errors import StudyError
from armscan.sweeps.scheduling.claim import PendingWrites, TrialOutcome
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.population import Population, PopulationSampler, _perturb, lineage, searched_values
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.space.space import Space
from armscan.sweeps.storage.attribute_names import LEASE
from armscan.sweeps.storage.attributes import check_trials
from armscan.sweeps.storage.storage import open_storage

SPACE = Space.read(
    {
        "agent.lr": {"low": 1e-4, "high": 1e-2, "log": True},
        "agent.gamma": {"low": 0.5, "high": 0.95, "step": 0.05},
        "agent.batch_size": {"choices": [64, 128, 256]},
        "agent.n_epochs": {"low": 1, "high": 8},
    }
)
SIZE, N_GENERATIONS, INTERVAL = 6, 5, 100


class Simulation:
    """A population without training: in each generation, a member's value improves by its learning rate."""

    def __init__(self, folder, seed=0, is_maximized=True, **settings):
        sampler = PopulationSampler(SIZE, INTERVAL, **settings)
        self.population = Population(sampler, SPACE, INTERVAL * N_GENERATIONS, is_maximized, seed)
        storage = open_storage(str(folder / "a.journal"))
        directions = ["maximize" if is_maximized else "minimize"]
        self.study = optuna.create_study(study_name="a", storage=storage.optuna, directions=directions)
        limits = Limits(n_trials=self.population.n_trials, max_failures=100, max_retries=1)
        self.scheduler = TrialScheduler(self.study, storage, limits, self.plan)
        self.sign = 1.0 if is_maximized else -1.0

    @property
    def trials(self):
        return self.study.get_trials(deepcopy=False)

    def plan(self):
        return self.population.plan(self.trials)

    def claim(self, worker=0):
        trial = self.scheduler.claim({"worker": str(worker)})
        if trial is not None:
            SPACE.suggest(trial)
        return trial

    def end(self, trial, state=TrialState.COMPLETE):
        attributes = trial.user_attrs
        parent = self.trials[attributes["parent"]].values[0] if "parent" in attributes else 0.0
        value = parent + self.sign * trial.params["agent.lr"]
        outcome = TrialOutcome(trial, state, PendingWrites(), values=[value] if state == TrialState.COMPLETE else None)
        self.scheduler.storage.exclusive(lambda: self.scheduler._tell(outcome, is_repeated=False))

    def run(self, n_workers, drawn, p_death=0.0, p_failure=0.0, seen=lambda: None):
        """Run the whole study, with workers that finish in any order and die, and trials that fail."""
        held = {}
        while True:
            for worker in range(n_workers):
                if worker not in held and (trial := self.claim(worker)) is not None:
                    held[worker] = trial
            seen()
            if not held:
                return self
            worker = drawn.choice(sorted(held))
            trial = held.pop(worker)
            if drawn.random() < p_death:
                self.scheduler.reclaim(lambda each, worker=worker: each.user_attrs[LEASE]["worker"] == str(worker))
            elif drawn.random() < p_failure:
                self.end(trial, TrialState.FAIL)
            else:
                self.end(trial)


def complete(simulation):
    return [trial for trial in simulation.trials if trial.state == TrialState.COMPLETE]


@pytest.mark.parametrize("n_workers", [1, 2, SIZE, 2 * SIZE])
@pytest.mark.parametrize(("p_death", "p_failure"), [(0.0, 0.0), (0.3, 0.0), (0.2, 0.2)])
def test_each_member_completes_each_generation_once_although_workers_die_and_trials_fail(
    tmp_path, n_workers, p_death, p_failure
):
    simulation = Simulation(tmp_path)
    to_keep = []

    def seen():
        to_keep.append((len(simulation.trials), simulation.population.checkpoints_to_keep(simulation.trials)))

    simulation.run(n_workers, random.Random(n_workers), p_death, p_failure, seen)
    trials = simulation.trials
    check_trials(simulation.study)
    places = sorted((trial.user_attrs["generation"], trial.user_attrs["member"]) for trial in complete(simulation))
    assert places == [(generation, member) for generation in range(N_GENERATIONS) for member in range(SIZE)]
    for trial in trials:
        if trial.user_attrs["generation"]:
            parent = trials[trial.user_attrs["parent"]]
            assert parent.state == TrialState.COMPLETE
            assert parent.user_attrs["generation"] == trial.user_attrs["generation"] - 1
            # Every decision before its claim has kept the checkpoint of its parent.
            before = [kept for n_trials, kept in to_keep if parent.number < n_trials <= trial.number]
            assert all(parent.number in kept for kept in before)
        start = trial.user_attrs["generation"] * INTERVAL
        assert trial.user_attrs["interval"] == [start, start + INTERVAL]
    # A checkpoint that was given up is never wanted again, and few are kept.
    for (n_before, before), (_, after) in pairwise(to_keep):
        assert not {each for each in after if each < n_before} - before
    assert max(len(kept) for _, kept in to_keep) <= 3 * SIZE + 2 * n_workers
    assert simulation.population.checkpoints_to_keep(trials) == set()
    assert (
        simulation.scheduler.end_reason(simulation.scheduler.state()) == f"{SIZE * N_GENERATIONS} trials have finished"
    )


def test_decisions_follow_from_the_storage_and_the_seed_alone(tmp_path):
    def decided(name, seed):
        (folder := tmp_path / name).mkdir()
        simulation = Simulation(folder, seed).run(2, random.Random(7), p_death=0.1)
        return [
            (trial.params, trial.user_attrs["schedule"], trial.user_attrs.get("parent")) for trial in simulation.trials
        ]

    assert decided("a", 3) == decided("b", 3)
    assert decided("c", 4) != decided("a2", 3)


@pytest.mark.parametrize("is_maximized", [True, False])
def test_worst_members_continue_from_the_best_with_other_values_and_all_others_as_they_were(tmp_path, is_maximized):
    simulation = Simulation(tmp_path, is_maximized=is_maximized).run(1, random.Random(0))
    trials, n_copies = simulation.trials, 0
    for generation in range(1, N_GENERATIONS):
        before = [trial for trial in complete(simulation) if trial.user_attrs["generation"] == generation - 1]
        ranked = sorted(before, key=lambda trial: simulation.sign * trial.values[0], reverse=True)
        for trial in (each for each in complete(simulation) if each.user_attrs["generation"] == generation):
            parent, own = trials[trial.user_attrs["parent"]], trial.user_attrs["member"]
            if own in [each.user_attrs["member"] for each in ranked[-2:]]:
                n_copies += 1
                assert parent in ranked[:2]
                assert trial.params != parent.params
                assert trial.user_attrs["schedule"][-1]["from_env_steps"] == generation * INTERVAL
            else:
                assert parent.user_attrs["member"] == own
                assert trial.params == parent.params
                assert trial.user_attrs["schedule"] == parent.user_attrs["schedule"]
    assert n_copies == 2 * (N_GENERATIONS - 1)


def test_population_does_better_than_values_that_stay_as_they_were_drawn(tmp_path):
    def best(name, **settings):
        (folder := tmp_path / name).mkdir()
        values = [trial.values[0] for trial in complete(Simulation(folder, **settings).run(2, random.Random(0)))]
        return max(values)

    # With so small a quantile, a single member exploits.
    assert best("a") > best("b", quantile=1e-9) > 0


def test_schedule_has_all_values_of_a_lineage_as_words_of_the_command_line(tmp_path):
    simulation = Simulation(tmp_path).run(2, random.Random(1))
    for trial in complete(simulation):
        now = {key: value for segment in trial.user_attrs["schedule"] for key, value in segment.items()}
        assert {key: now[key] for key in trial.params} == trial.params
        ancestors = list(lineage(simulation.trials, trial))
        assert [each.user_attrs["generation"] for each in ancestors] == list(range(trial.user_attrs["generation"] + 1))
        assert trial.user_attrs["schedule"][0] == {"from_env_steps": 0} | ancestors[0].params
        words = overrides_of(searched_values(trial))
        n_changes = len(trial.user_attrs["schedule"]) - 1
        assert words[: len(SPACE.parameters)] == overrides_of(ancestors[0].params)
        assert sum(word.startswith("training.schedule=[{from_env_steps:") for word in words) == (n_changes > 0)


@pytest.mark.parametrize(
    ("distribution", "value", "allowed"),
    [
        (FloatDistribution(1.0, 10.0), 5.0, {4.0, 6.0}),
        (FloatDistribution(1.0, 10.0), 9.0, {9.0 * 0.8, 10.0}),
        (FloatDistribution(-4.0, -1.0), -2.0, {-1.6, -2.4}),
        (FloatDistribution(0.0, 1.0, step=0.25), 0.5, {0.25, 0.75}),
        (IntDistribution(1, 8), 2, {1, 3}),
        (IntDistribution(1, 8), 1, {1, 2}),
        (IntDistribution(1, 100), 50, {40, 60}),
        (CategoricalDistribution([64, 128, 256]), 128, {64, 256}),
        (CategoricalDistribution([64, 128, 256]), 256, {128}),
        (CategoricalDistribution([64]), 64, {64}),
    ],
)
def test_value_is_changed_by_a_fifth_or_to_the_choice_beside_it(distribution, value, allowed):
    changed = {_perturb(value, distribution, np.random.default_rng(seed)) for seed in range(30)}
    assert sorted(changed) == pytest.approx(sorted(allowed))
    assert all(distribution._contains(distribution.to_internal_repr(each)) for each in changed)


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        ("parent", 7, "a.trials[0].user_attrs.parent is 7, but it must be a trial before it"),
        (
            "schedule",
            [{"agent._target_": 1}],
            "a.trials[0].user_attrs.schedule is [{'agent._target_': 1}], but it must be",
        ),
        (
            "schedule",
            [{"agent.lr": "os.system"}],
            "a.trials[0].user_attrs.schedule is [{'agent.lr': 'os.system'}], but",
        ),
        ("interval", [1], "a.trials[0].user_attrs.interval is [1], but it must be two numbers of environment steps"),
    ],
)
def test_attributes_that_a_stranger_wrote_are_refused_in_one_line(tmp_path, name, value, line):
    study = optuna.create_study(study_name="a", storage=f"sqlite:///{tmp_path}/a.db")
    study.enqueue_trial({}, user_attrs={name: value})
    with pytest.raises(Exception, match=r"a\.trials") as raised:
        check_trials(study)
    assert str(raised.value).startswith(line)
    assert isinstance(raised.value, StudyError | ValueError)


def test_checkpoint_of_a_dead_attempt_is_kept_for_its_retry(tmp_path):
    simulation = Simulation(tmp_path)
    dead = simulation.claim()
    simulation.scheduler.reclaim(lambda _: True)
    # Waiting, then running.
    for _ in range(2):
        assert dead.number in simulation.population.checkpoints_to_keep(simulation.trials)
        simulation.claim()
