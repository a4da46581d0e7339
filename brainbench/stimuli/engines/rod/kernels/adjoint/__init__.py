"""Kernels of gradients: ``recording`` writes steps down (``records``), ``chain`` goes back over them, ``tangent`` on.

Both take a step as it was (``restoring``) and carry ``fields`` along the chain; ``contacts`` solves for what the
contacts add, with ``dense`` systems; ``surfaces`` and ``pose`` hand it on to shapes and to the tracks of bodies.
``newton`` solves the contact forces of recorded steps to rounding. The equations are those of
:mod:`brainbench.stimuli.engines.rod.adjoint`.
"""
