"""The best job of a grid."""

import json
from types import SimpleNamespace

from armscan.launch.best_job import best_job


def job(limits, **rates):
    metrics = {f"test_volumes/on_plane_{name}": rate for name, rate in rates.items()}
    return SimpleNamespace(data=SimpleNamespace(params={"evaluation.on_plane": json.dumps(limits)}, metrics=metrics))


def test_best_job_is_the_one_by_the_leading_limits():
    jobs = [
        job([[2, 5], [5, 10]], **{"2mm_5deg": narrow, "5mm_10deg": wide}) for narrow, wide in ((0.8, 0.85), (0.1, 0.9))
    ]
    assert best_job(jobs) is jobs[0]
    assert best_job([job([[5, 10]])]) is None
    assert best_job([*jobs, job([[5, 10]], **{"5mm_10deg": 1.0})]) is None
    assert best_job([]) is None
