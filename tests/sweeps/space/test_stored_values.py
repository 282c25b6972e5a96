"""Values that a hostile storage has for a study: refused in one line, never a key or a class."""

import optuna
import pytest

from armscan.errors import InvalidValueError, TrackingError
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.space.space import Space
from armscan.tracking.outbox import file_of

SPACE = {
    "agent.lr": {"low": 1e-4, "high": 1e-2, "log": True},
    "agent.n": {"low": 1, "high": 8},
    "obs": {"choices": ["plane", "image"]},
}
SOUND = {"agent.lr": 1e-3, "agent.n": 2, "obs": "plane"}


def chosen_of(params):
    study = optuna.create_study()
    study.enqueue_trial(params)
    return Space.read(SPACE).suggest(study.ask())


@pytest.mark.filterwarnings("ignore")
def test_key_that_is_not_searched_never_becomes_an_override():
    hostile = {
        "agent._target_": "os.system",
        "+data.command": "touch /tmp/x",
        "hydra.run.dir": "/",
        "--config-dir": "/",
    }
    assert chosen_of(SOUND | hostile) == SOUND
    assert overrides_of(chosen_of(SOUND | hostile)) == ["agent.lr=0.001", "agent.n=2", "obs=plane"]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("agent.lr", each) for each in (5.0, -1.0, 0, "nan", "0.001", "${oc.env:HOME}", {"_target_": "os.system"})),
        *(("agent.n", each) for each in (9, 10**30, "{_target_:os.system}")),
        *(("obs", each) for each in ("../../x", "${oc.env:HOME}", "{_target_:os.system}", ["plane"], None)),
    ],
)
def test_value_outside_the_space_is_refused_in_one_line(name, value):
    with pytest.raises(
        InvalidValueError, match=f"^{name} has a value in the study.s storage that is not in"
    ) as refused:
        chosen_of(SOUND | {name: value})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("run_id", ["../../x", "/etc/passwd", "a/b", "", ".", "a\0", 3, None, "a" * 65])
def test_run_of_a_trial_that_is_no_id_names_no_file(tmp_path, run_id):
    with pytest.raises(TrackingError, match="is not the ID of a run"):
        file_of(tmp_path, run_id)
