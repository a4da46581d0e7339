"""The static site of a leaderboard.

:mod:`build` writes it: the first page from :mod:`table`, one page per model from :mod:`score_page`, and the
:mod:`downloads`; :mod:`page` fills the templates and locks every page; :mod:`serve` shows a built site.
"""
