"""MLflow tracking: the store, its runs, and their plots."""

from armscan.tracking.environment import environment_file, environment_tags
from armscan.tracking.git import code_state, code_version
from armscan.tracking.lookup import (
    FoundRun,
    check_run_id,
    check_version,
    find_run,
    load_agent_run,
    load_run,
    run_of_study,
)
from armscan.tracking.outbox import take_over
from armscan.tracking.plots import draw_learning_curve
from armscan.tracking.run import TrackedRun
from armscan.tracking.run_end import begin_outbox, fail_dead_runs, record_end
from armscan.tracking.sanitize import flatten, tags_of
from armscan.tracking.settings import TrackingSettings
from armscan.tracking.store import check_artifacts, open_existing_store, open_store
from armscan.tracking.sync import sync, upload_pending
from armscan.tracking.tracking_store import TrackingStore

__all__ = [
    "FoundRun",
    "TrackedRun",
    "TrackingSettings",
    "TrackingStore",
    "begin_outbox",
    "check_artifacts",
    "check_run_id",
    "check_version",
    "code_state",
    "code_version",
    "draw_learning_curve",
    "environment_file",
    "environment_tags",
    "fail_dead_runs",
    "find_run",
    "flatten",
    "load_agent_run",
    "load_run",
    "open_existing_store",
    "open_store",
    "record_end",
    "run_of_study",
    "sync",
    "tags_of",
    "take_over",
    "upload_pending",
]
