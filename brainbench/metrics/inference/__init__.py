"""Inference: ``permutation`` tests, and comparisons of ``multiple`` models or layers."""
