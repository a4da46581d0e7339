"""Counted trials from sessions of spike times or signals.

``selection`` says what is read: labels, rules and windows; ``counting`` reads one session (spikes, or ``signals``), and
``session_trials`` joins probes and sessions to one data set and hands it to metrics.
"""
