"""The examples in the docstrings run and print what they say."""

from __future__ import annotations

import doctest
import importlib

import pytest


@pytest.mark.parametrize(
    "module",
    [
        "rdms.dissimilarity",
        "rdms.comparison",
        "reliability.noise_correction",
        "inference.permutation",
        "inference.multiple",
        "measures.decoding",
    ],
)
def test_the_examples_of_the_docstrings_hold(module):
    result = doctest.testmod(importlib.import_module(f"brainbench.metrics.{module}"))
    assert result.attempted >= 1
    assert result.failed == 0
