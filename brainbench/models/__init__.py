"""Artificial networks of touch: temporal graphs, encoders, attenders, decoders, and how to get one by name.

Public modules: :mod:`~brainbench.models.registry` (models by name), :mod:`~brainbench.models.user` (models
from a user's file), :mod:`~brainbench.models.extract` (activations), :mod:`~brainbench.models.graph` and
:mod:`~brainbench.models.graph_spec` (temporal graphs), :mod:`~brainbench.models.cells`,
:mod:`~brainbench.models.ead` (encoder-attender-decoder), :mod:`~brainbench.models.decoders`.
Importing this package imports no framework.
"""
