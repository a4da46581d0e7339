"""Kernels of derivatives. They are loaded as the package ``recorder`` of the kernels of the engine ``rod``, whose
modules are therefore ``..algebra``, ``..state`` and so on (``brainbench.stimuli.engines.rod.kernels.specialize``).

The engine calls ``recording``, which writes steps down, and ``newton``, which solves their contact forces to rounding.
``tangent`` goes over the steps again: ``chain`` takes a step as it was and carries changes along the chain, and
``contacts`` finds what the contacts add. The equations are those of
:mod:`brainbench.stimuli.fitting.recorded_run`.
"""
