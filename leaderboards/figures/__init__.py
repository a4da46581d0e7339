"""Figures of leaderboards, from entries to SVG.

:mod:`charts` draws the figures of a board, with the row charts and scatter plots of :mod:`plots`; :mod:`architecture`
draws a model's graph; both on the drawings and axes of :mod:`svg`. :mod:`marks` places the charts of a single record.
"""
