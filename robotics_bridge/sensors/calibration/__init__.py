"""Noise knobs fitted to a recording of a real device, an optional room.

``calibrate`` reads the recording, decides and reports, ``likelihood`` fits the dynamics and the delays, ``commands``
brings ``brainbench tactile calibrate``.
"""
