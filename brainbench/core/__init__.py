"""Foundations of every package, lowest first; nothing here imports another package of ours.

:mod:`~brainbench.core.errors` · :mod:`~brainbench.core.files` (atomic writes, hashes, cache) ·
:mod:`~brainbench.core.limits` and :mod:`~brainbench.core.limits` (options) · :mod:`~brainbench.core.plugins`
(objects of users, optional folders) · :mod:`~brainbench.core.contracts` (what packages exchange),
:mod:`~brainbench.core.records` (scores), :mod:`~brainbench.core.identity` (what makes two of them the same) ·
:mod:`~brainbench.core.statistics`, :mod:`~brainbench.core.rotations`, :mod:`~brainbench.core.tradeoffs` ·
:mod:`~brainbench.core.progress`, :mod:`~brainbench.core.runs` (pools of jobs, the life of a
run) and :mod:`~brainbench.core.devices`.
"""
