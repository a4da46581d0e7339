"""Derivatives of simulated whiskers: the engine ``rod`` writes its steps down, and kernels here go over them again.

:mod:`.packed_changes` says how packed numbers change with a parameter, :mod:`.recorded_run` records a launch and gives
the change of its results. The engine knows the folder ``kernels`` only as the package that it is given as its recorder.
"""
