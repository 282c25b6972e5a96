"""Volumes that several processes have in memory once."""

import pickle
from functools import partial

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv

from armscan.envs import make_armscan_env
from armscan.errors import InvalidValueError, VolumeError
from armscan.volumes import shared_volumes


@pytest.fixture
def shared(phantom):
    with shared_volumes({"phantom-0": phantom}) as volumes:
        yield volumes


def test_shared_volume_is_the_same_volume(shared, phantom):
    volume = shared["phantom-0"]
    np.testing.assert_array_equal(volume.labels, phantom.labels)
    for name in ("spacing", "name", "optimal_action", "origin", "size_mm", "centre_mm"):
        assert getattr(volume, name) == getattr(phantom, name)
    with pytest.raises(ValueError, match="read-only"):
        volume.labels[0, 0, 0] = 1
    np.testing.assert_array_equal(volume.slice(phantom.optimal_action), phantom.slice(phantom.optimal_action))


def test_shared_volume_is_pickled_without_its_voxels(shared):
    pickled = pickle.dumps(shared["phantom-0"])
    assert len(pickled) < 2000
    opened = pickle.loads(pickled)
    np.testing.assert_array_equal(opened.labels, shared["phantom-0"].labels)
    assert len(pickle.dumps(opened)) < 2000


def test_shared_volumes_serve_environments_of_other_processes(shared):
    make = partial(make_armscan_env, shared, max_steps=3)
    envs = AsyncVectorEnv([make] * 2, context="spawn")
    try:
        observed, _ = envs.reset(seed=[5, 5])
    finally:
        envs.close()
    np.testing.assert_array_equal(observed[0], observed[1])
    np.testing.assert_array_equal(observed[0], make().reset(seed=5)[0])


def test_shared_volumes_leave_no_file_behind(phantom):
    with shared_volumes({"phantom-0": phantom}) as volumes:
        path = volumes["phantom-0"].path
        pickled = pickle.dumps(volumes["phantom-0"])
        assert path.stat().st_size == phantom.labels.size
    assert not path.parent.exists()
    # Who has it keeps it; nobody else gets it.
    np.testing.assert_array_equal(volumes["phantom-0"].labels, phantom.labels)
    with pytest.raises(VolumeError, match="phantom-0: its shared voxels are gone"):
        pickle.loads(pickled)


def test_shared_volumes_refuse_what_is_no_volume():
    with pytest.raises(InvalidValueError, match="volumes holds 3 as 'a'"), shared_volumes({"a": 3}):
        pass
