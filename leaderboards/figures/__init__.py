"""Figures of leaderboards: marks, plots, charts and architecture diagrams."""
