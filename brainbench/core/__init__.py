"""Foundations of every package, lowest first; nothing here imports another package of ours.

:mod:`~brainbench.core.errors` · :mod:`~brainbench.core.files` (atomic writes, hashes, cache) and
:mod:`~brainbench.core.plugins` (objects of users) · :mod:`~brainbench.core.contracts` (the data sets that packages
exchange), :mod:`~brainbench.core.trials`, :mod:`~brainbench.core.labels` and :mod:`~brainbench.core.records` (scores)
· :mod:`~brainbench.core.statistics`, :mod:`~brainbench.core.rotations` and :mod:`~brainbench.core.tradeoffs` ·
:mod:`~brainbench.core.devices` and :mod:`~brainbench.core.cuda_graphs`.
"""
