"""Kernels of gradients: ``recording`` writes steps down (``records``), ``chain`` goes back over them.

It carries ``fields`` up the chain; ``contacts`` solves for the contacts' multipliers, ``surfaces`` and ``pose`` hand on
what contacts give to shapes and to the tracks of bodies. The equations are those of
:mod:`brainbench.stimuli.engines.rod.adjoint`.
"""
