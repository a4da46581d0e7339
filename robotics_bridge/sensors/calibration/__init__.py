"""Noise knobs fitted to a recording of a real device.

``log`` reads it, ``delays`` and ``likelihood`` fit, ``calibrate`` decides and reports.
"""
