"""Checks of recordings, worst finding first.

``checkup`` opens the files and runs ``tables``, ``labels``, ``spikes`` and ``clock``, which yield ``findings``.
"""
