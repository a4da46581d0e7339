"""Counted trials from sessions of spike times.

Conditions label the trials, a selection keeps some, windows say when to read (``conditions``, ``selection``,
``windows``); ``counting`` counts one session, ``joining`` makes one data set, ``session_trials`` hands it to metrics.
"""
