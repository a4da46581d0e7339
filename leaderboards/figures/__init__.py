"""Figures of leaderboards, from entries to SVG.

:mod:`charts` draws the figures of a board, with the row charts and scatter plots of :mod:`plots`, and :mod:`record`
those of one model; :mod:`architecture` draws a model's graph; all on the drawings and axes of :mod:`svg`. :mod:`rdms`
makes pictures of dissimilarity matrices.
"""
