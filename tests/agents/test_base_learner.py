"""The base of all learners, and the imports it defers."""

from tests.support.programs import output_of

LEARNS_THEN_COMPILES = """
import sys, torch
from armscan.agents import MLP, SAC
from armscan.volumes import load_phantom
from tests.agents.conftest import ENV_FACTORIES, SMALL_SAC, setup_for
learner = SAC(network=MLP((8,)), **SMALL_SAC).agent(setup_for(ENV_FACTORIES["vector"][0], load_phantom(0)))
learner.warm_up()
learner.learn(40)
learner.load_state(learner.state())
print("torch._dynamo" in sys.modules)
compiled = torch.compile(learner._algorithm.policy.actor.mu, backend="eager")
optimiser = torch.optim.Adam(compiled.parameters(), lr=0.1)
before = [part.detach().clone() for part in compiled.parameters()]
compiled(torch.ones(3, 8)).sum().backward()
optimiser.step()
print(all(bool((part != its_like).any()) for part, its_like in zip(compiled.parameters(), before)))
"""


def test_learner_never_loads_torchs_compiler_which_works_all_the_same():
    assert output_of(LEARNS_THEN_COMPILES).split()[-2:] == ["False", "True"]
