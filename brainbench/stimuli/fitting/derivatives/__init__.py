"""Derivatives of simulated whiskers: the engine ``rod`` writes its steps down, and kernels here go over them again.

:mod:`.recorded_run` records a launch and gives the change of its results with that of what was packed. The
engine knows the folder ``kernels`` only as the package that it is given as its recorder.
"""
