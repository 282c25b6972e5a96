"""The charts of a study's report."""

import optuna
from optuna.study import StudyDirection
from optuna.trial import create_trial

from armscan.sweeps.results.charts import _history


def test_best_so_far_is_of_trials_that_keep_all_constraints():
    study = optuna.create_study()
    for value, violation in ((3.0, -0.1), (1.0, 0.5), (2.0, 0.0)):
        study.add_trial(create_trial(value=value, constraints={"training_s <= 60": violation}))
    figure = _history(study.trials, 0, "mean_steps", StudyDirection.MINIMIZE)
    drawn = {trace.name: list(zip(trace.x, trace.y, strict=True)) for trace in figure.data}
    assert drawn == {
        "trial": [(0, 3.0), (2, 2.0)],
        "infeasible trial": [(1, 1.0)],
        "best so far": [(0, 3.0), (2, 2.0)],
    }
