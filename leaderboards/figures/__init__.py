"""Figures of leaderboards, from entries to SVG.

:mod:`charts` draws the figures of a board and :mod:`record` those of one model, its graph included, on the drawings,
axes and row charts of :mod:`svg`. :mod:`rdms` makes pictures of dissimilarity matrices.
"""
