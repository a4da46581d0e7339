"""Obstacles that several engines are tested with."""

from __future__ import annotations

from brainbench.stimuli.objects.obstacle import Capsule, Obstacle


def post(x, y, radius=1e-3, **options):
    """Return a post along z through (x, y), 40 mm long; lengths in m."""
    return Obstacle((Capsule((x, y, -0.02), (x, y, 0.02), radius),), **options)
