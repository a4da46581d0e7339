"""The static site of a leaderboard.

:mod:`build` writes it: the first page, the table as data for its downloads, and one page per model from
:mod:`score_page`, which fills the templates and locks every page.
"""
