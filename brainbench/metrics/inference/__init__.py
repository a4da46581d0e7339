"""Inference: ``permutation`` tests, ``intervals`` over animals and stimuli, ``multiple`` models or layers, and
``equivalence`` with the animals."""
