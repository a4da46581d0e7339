from __future__ import annotations

import pytest

from brainbench.core import plugins
from brainbench.core.errors import MissingDependencyError, UsageError
from brainbench.geometry import DecompositionSettings, Mesh, decompose


def test_v_hacd_takes_no_number_of_pieces():
    with pytest.raises(UsageError, match="no limit on the number of pieces"):
        DecompositionSettings(method="vhacd", most_pieces=4)


def test_without_the_folder_a_decomposition_says_which_folder_it_needs(monkeypatch):
    monkeypatch.setattr(plugins.OptionalPart, "present", False)
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    with pytest.raises(MissingDependencyError, match="brainbench/geometry/decomposition"):
        decompose(mesh)
