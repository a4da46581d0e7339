"""Inference: ``permutation`` tests, the ``bootstrap`` and its ``intervals``, ``multiple`` models or layers,
``equivalence`` with the animals, and the ``power`` of a planned experiment."""
