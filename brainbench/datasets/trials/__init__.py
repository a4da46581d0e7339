"""Counted trials from sessions of spike times or signals.

``selection`` labels the trials and keeps some, ``windows`` say when to read; ``counting`` reads one session (spikes, or
``signals``), ``copies`` joins probes, ``session_trials`` makes one data set and hands it to metrics.
"""
