"""The view of an experiment's runs in MLflow: the columns that matter, and learning curves as the first charts.

MLflow stores a shared view as a tag of the experiment, and shows it if the URL names its key.
"""

from __future__ import annotations

import json

from armscan.stats.on_plane import ON_PLANE
from armscan.tracking.tags import SELECTION_PREFIX, TEST_VOLUMES_PREFIX, VALIDATION_PREFIX

VIEW_KEY = "armscan"
VIEW_TAG = f"mlflow.sharedViewState.{VIEW_KEY}"
LEADING = ON_PLANE[0].metric
FIGURES = (LEADING, "median_distance_mm", "median_distance_deg", "success_rate", "mean_steps")
CURVES = {
    f"{VALIDATION_PREFIX}{LEADING}": ON_PLANE[0].title,
    f"{VALIDATION_PREFIX}success_rate": "success, by reward",
    f"{VALIDATION_PREFIX}mean_steps": "steps, mean",
}
SECTION = "learning-curves"
# Width of a letter in a column heading, and of the space around the heading.
LETTER_PX, AROUND_PX = 6, 40


def artifact_address(run_id: str, file: str) -> str:
    """Return the address of a run's artifact, relative to the pages of MLflow's UI."""
    return f"get-artifact?path={file}&run_uuid={run_id}"


def _line(metric: str, title: str) -> dict[str, object]:
    """Return MLflow's description of a line chart of a metric by environment step."""
    return {
        "type": "LINE",
        "uuid": f"{SECTION}-{metric.rpartition('/')[2]}",
        "metricSectionId": SECTION,
        "metricKey": metric,
        "selectedMetricKeys": [metric],
        "displayName": title,
        "xAxisKey": "step",
        "runsCountToCompare": 10,
        "lineSmoothness": 0,
        "scaleType": "linear",
        "deleted": False,
        "isGenerated": False,
    }


def _columns() -> dict[str, int]:
    """Return the columns in their order, each with its width in pixels."""
    leading, *others = (f"{TEST_VOLUMES_PREFIX}{name}" for name in FIGURES)
    metrics = [
        leading,
        f"random/{LEADING}",
        *others,
        *(f"{prefix}{LEADING}" for prefix in (SELECTION_PREFIX, VALIDATION_PREFIX)),
    ]
    return {
        **{f"metrics.`{name}`": LETTER_PX * len(name) + AROUND_PX for name in metrics},
        "params.`seed`": 80,
        "tags.`overrides`": 260,
        "tags.`pruned`": 90,
    }


VIEW = json.dumps(
    {
        "selectedColumns": [*_columns()],
        "columnOrder": [*_columns()],
        "columnWidths": _columns(),
        "compareRunCharts": [_line(*each) for each in CURVES.items()],
        "compareRunSections": [
            {"uuid": SECTION, "name": "Learning curves, validation", "display": True, "isReordered": False}
        ],
        "isAccordionReordered": True,
    },
    ensure_ascii=False,
)
