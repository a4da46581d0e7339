"""The static site of a leaderboard.

:mod:`build` writes it: the first page and the downloads from :mod:`table`, and one page per model from
:mod:`score_page`, which fills the templates and locks every page.
"""
