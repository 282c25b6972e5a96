"""Evaluation of a trained agent on any volumes."""

from armscan.evaluation.agent_source import TrainedAgent, agent_of_overrides, agent_of_run
from armscan.evaluation.report import EvaluationReport, report_tables
from armscan.evaluation.runner import AgentEvaluator, prepare
from armscan.evaluation.volumes import TrainingVolumes, data_name, known_volumes, own_split, volume_groups
from armscan.training import PARTS

__all__ = [
    "PARTS",
    "AgentEvaluator",
    "EvaluationReport",
    "TrainedAgent",
    "TrainingVolumes",
    "agent_of_overrides",
    "agent_of_run",
    "data_name",
    "known_volumes",
    "own_split",
    "prepare",
    "report_tables",
    "volume_groups",
]
