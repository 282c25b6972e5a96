"""MLflow: the store, its runs, and the pictures that go there."""

from armscan.tracking.client import TrackingStore
from armscan.tracking.environment import environment_file, environment_tags
from armscan.tracking.finding import (
    EVALUATED_TAG,
    FAMILIAR_TAG,
    VERSION_TAG,
    FoundRun,
    check_version,
    find_run,
    found_run,
    jobs_of,
)
from armscan.tracking.limits import flattened, tags_of
from armscan.tracking.pictures import draw_learning_curve
from armscan.tracking.run import TrackedRun
from armscan.tracking.source import source, source_tags
from armscan.tracking.spool import take_over
from armscan.tracking.store import check_artifacts, open_existing_store, open_store
from armscan.tracking.sync import abandon, deliver_leftovers, note_end, sync

__all__ = [
    "EVALUATED_TAG",
    "FAMILIAR_TAG",
    "VERSION_TAG",
    "FoundRun",
    "TrackedRun",
    "TrackingStore",
    "abandon",
    "check_artifacts",
    "check_version",
    "deliver_leftovers",
    "draw_learning_curve",
    "environment_file",
    "environment_tags",
    "find_run",
    "flattened",
    "found_run",
    "jobs_of",
    "note_end",
    "open_existing_store",
    "open_store",
    "source",
    "source_tags",
    "sync",
    "tags_of",
    "take_over",
]
