"""Noise of readings: ``model`` holds the knobs of a sensor, ``stages`` applies them to whole readings.

Sensors that fuse the noise into their own kernels call the functions of ``kernels.noise``.
"""
