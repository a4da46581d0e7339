"""Comparison of distilled students: what evaluations say (results), tables, a figure, records of a leaderboard."""

from robotics_bridge.policies.report.records import command, records
from robotics_bridge.policies.report.results import (
    AGENTS,
    EVALUATION,
    GRADED,
    LeftOut,
    StudentResult,
    mixed_model,
    read_agents,
    read_results,
)
from robotics_bridge.policies.report.tables import COLUMNS, agent_rows, concise, remarks, rows, sense

__all__ = [
    "AGENTS",
    "COLUMNS",
    "EVALUATION",
    "GRADED",
    "LeftOut",
    "StudentResult",
    "agent_rows",
    "command",
    "concise",
    "mixed_model",
    "read_agents",
    "read_results",
    "records",
    "remarks",
    "rows",
    "sense",
]
