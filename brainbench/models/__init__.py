"""Artificial networks of touch: temporal graphs, encoders, attenders, decoders, and how to get one by name.

Public modules: :mod:`~brainbench.models.registry` (models by name), :mod:`~brainbench.models.user_models` (models
from a user's file), :mod:`~brainbench.models.activations` (activations),
:mod:`~brainbench.models.graph.temporal_graph` and
:mod:`~brainbench.models.graph.spec` (temporal graphs), :mod:`~brainbench.models.cells`,
:mod:`~brainbench.models.network` (encoder-attender-decoder), :mod:`~brainbench.models.heads.decoders`.
Importing this package imports no framework.
"""
