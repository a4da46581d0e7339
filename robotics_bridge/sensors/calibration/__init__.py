"""Noise knobs fitted to a recording of a real device, an optional room.

``log`` reads the recording, ``likelihood`` fits the dynamics and the delays, ``calibrate`` decides and reports,
``commands`` brings ``brainbench tactile calibrate``.
"""
