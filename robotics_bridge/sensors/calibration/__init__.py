"""Noise, law and places of the taxels of a real device, fitted to a recording of it: an optional room.

``calibrate`` reads the recording; with a reference signal, or at rest, ``likelihood`` fits dynamics and delays. With a
ball that presses, ``presses`` predicts the readings and ``devices`` fits all numbers at once. ``commands`` brings
``brainbench tactile calibrate``.
"""
