"""Figures: force traces, and pictures and films of scenes, without a display or OpenGL.

``camera`` frames the world, ``surfaces`` makes triangles of objects and whiskers and lights the visible ones,
``pictures`` joins these and writes around them, and ``scenes`` makes files of them, films too. ``traces`` are charts;
``brainbench.core.figures`` holds the look of all charts.
"""
