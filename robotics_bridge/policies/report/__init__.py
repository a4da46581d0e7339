"""Comparison of distilled students: what their evaluations say (``results``) as ``tables``, a ``figure``, and
``records`` of a leaderboard."""
