import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.geometry import DecompositionSettings, Mesh, decompose


def _angle_bracket(name="bracket"):
    """Two boxes joined to an L, of two convex pieces."""
    corners = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], float)
    flat = np.hstack([np.vstack([corners, corners]), np.repeat([[0.0], [1.0]], 6, axis=0)])
    caps = [[0, 1, 2], [0, 2, 3], [0, 3, 5], [3, 4, 5]]
    bottom = [[a, c, b] for a, b, c in caps]
    top = [[a + 6, b + 6, c + 6] for a, b, c in caps]
    sides = [f for i in range(6) for j in [(i + 1) % 6] for f in ([i, j, j + 6], [i, j + 6, i + 6])]
    return Mesh(flat, bottom + top + sides, name)


def test_the_limit_of_memory_is_kept_in_words():
    with pytest.raises(DataError, match=r"'big' .*0\.1 GB"):
        decompose(_angle_bracket("big"), DecompositionSettings(memory=1e8, seed=7))


@pytest.mark.slow
def test_v_hacd_gives_convex_pieces_too():
    result = decompose(_angle_bracket(), DecompositionSettings(method="vhacd"))
    assert result.deviation.largest < 0.05 * _angle_bracket().diagonal
    assert "(vhacd)" in result.notes[0]
