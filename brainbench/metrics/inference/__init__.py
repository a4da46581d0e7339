"""Inference: ``permutation`` tests, ``intervals`` over animals and stimuli, ``multiple`` models or layers,
``equivalence`` with the animals, and the ``power`` of a planned experiment."""
