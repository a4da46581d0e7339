"""Figures: force traces, trade-offs, and pictures and films of scenes, without a display or OpenGL.

``camera`` frames the world, ``surfaces`` makes triangles of objects and whiskers, ``raster`` finds the visible ones,
``shading`` lights them, ``annotation`` writes around them, and ``scenes`` joins these into pictures and ``films``.
``traces`` and ``tradeoff`` are charts; ``canvas`` holds what pictures of whiskers share, and
``brainbench.core.figures.style`` the look of all charts.
"""
