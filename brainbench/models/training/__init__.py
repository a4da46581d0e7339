"""Training: one run in a folder, resumed exactly after any interruption.

Public modules: :mod:`~brainbench.models.training.config` (what is trained and how),
:mod:`~brainbench.models.training.trainer` (train), :mod:`~brainbench.models.training.batches` (where data come from),
:mod:`~brainbench.models.training.search_space` (search spaces). Importing this package imports no framework.
"""
