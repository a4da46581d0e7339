"""Training: one run in a folder, resumed exactly after any interruption.

Public modules: :mod:`~brainbench.models.training.config` (what is trained and how),
:mod:`~brainbench.models.training.run` (train), :mod:`~brainbench.models.training.batches` (where data come from),
:mod:`~brainbench.models.training.sweep` (search spaces). Importing this package imports no framework.
"""
