"""A study in PostgreSQL on an MLflow server, with workers on any machine."""

import pytest

from tests.cluster.studies import StartedStudy


@pytest.fixture
def start(tmp_path, postgres, tracking_server):
    """Start a study in an empty folder; it is ended with the test."""
    started = []

    def start(*words, environment):
        study = StartedStudy(tmp_path, words, postgres.make_database(), tracking_server.uri, environment)
        started.append(study)
        return study

    yield start
    for study in started:
        study.kill()
