"""Scores of groups of units, such as cortical areas, layers or cell types: which group does a model explain best?

An optional room, which nothing else imports; ``--by`` is its entry point.
"""

from brainbench.scoring.groups.board import GroupBoard, GroupScore, score_groups

__all__ = ["GroupBoard", "GroupScore", "score_groups"]
