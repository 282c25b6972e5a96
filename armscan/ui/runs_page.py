"""Address of the page in MLflow's UI that shows the runs, which its home page does not."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Mapping
from typing import Any
from urllib.error import URLError
from urllib.parse import quote

from armscan.tracking.view import VIEW_KEY, VIEW_TAG

API, TIMEOUT_S = "/api/2.0/mlflow", 20.0
MAX_EXPERIMENTS = 200


def runs_page(address: str) -> str:
    """Return the address of the page with the runs of the latest run's experiment, with the columns that matter.

    Args:
        address: Address of an MLflow server that answers.

    Returns:
        The address; the page of all experiments if there is no run, or the server does not answer as expected.
    """
    try:
        experiments = _asked(address, "experiments", {"max_results": MAX_EXPERIMENTS}).get("experiments", [])
        by_id = {str(each["experiment_id"]): each for each in experiments}
        latest = {"experiment_ids": [*by_id], "max_results": 1, "order_by": ["attributes.start_time DESC"]}
        runs = _asked(address, "runs", latest).get("runs", []) if by_id else []
        if not runs:
            return f"{address}/#/experiments"
        experiment_id = str(runs[0]["info"]["experiment_id"])
        tags = {tag["key"] for tag in by_id[experiment_id].get("tags", ())}
    except (URLError, OSError, ValueError, KeyError, TypeError, AttributeError):
        return f"{address}/#/experiments"
    view = f"&viewStateShareKey={VIEW_KEY}" if VIEW_TAG in tags else ""
    return f"{address}/#/experiments/{quote(experiment_id)}/runs?workflowType=machine_learning{view}"


def _asked(address: str, of: str, query: Mapping[str, Any]) -> Any:
    request = urllib.request.Request(
        f"{address}{API}/{of}/search", json.dumps(query).encode(), {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
        return json.loads(answer.read())
