"""Distribution of tests among workers."""

import os

import pytest


@pytest.mark.xdist_group("one_worker")
def test_tests_of_a_group_are_given_to_one_worker(request):
    is_grouped = "PYTEST_XDIST_WORKER" in os.environ and request.config.getvalue("loadgroup")
    # Where pytest-xdist cannot add the group to the name, it gives the tests to any worker, and says nothing.
    assert request.node.nodeid.endswith("@one_worker") == bool(is_grouped)
