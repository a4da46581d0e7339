"""Figures: force traces, and pictures and films of scenes, without a display or OpenGL.

``surfaces`` frames the world, makes triangles of objects and whiskers and lights the visible ones. ``pictures`` joins
these and writes around them, makes files of scenes, films too, and draws charts of forces; ``brainbench.core.figures``
holds the look of all charts.
"""
