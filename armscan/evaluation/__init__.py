"""Evaluation of a trained agent on any volumes."""

from armscan.evaluation.agent_source import EvaluatedAgent, agent_of_overrides, agent_of_run
from armscan.evaluation.report import EvaluationReport, report_tables
from armscan.evaluation.runner import prepare_on_volumes
from armscan.evaluation.volumes import own_split

__all__ = [
    "EvaluatedAgent",
    "EvaluationReport",
    "agent_of_overrides",
    "agent_of_run",
    "own_split",
    "prepare_on_volumes",
    "report_tables",
]
