import pytest

from brainbench.core.errors import UsageError
from brainbench.scoring.recovery import Recovery, plot_confusion
from brainbench.scoring.recovery.boards import RecoveryBoard
from tests.factories.candidates import DESIGN


def test_equal_recoveries_have_equal_pictures(tmp_path):
    pytest.importorskip("matplotlib")
    boards = (RecoveryBoard(0, 0, "x", (0.9, 0.2), (0, 1), 0.5), RecoveryBoard(1, 0, "x", (0.9, 0.2), (0, 0), 0.5))
    found = Recovery(("a", "b"), DESIGN, 12, boards)
    pictures = [plot_confusion(found, tmp_path / name).read_bytes() for name in ("a.png", "b.png")]
    assert pictures[0] == pictures[1]
    other = Recovery(("a", "b"), DESIGN, 12, boards[:1])
    assert plot_confusion(other, tmp_path / "c.png").read_bytes() != pictures[0]
    with pytest.raises(UsageError, match=r"\.png"):
        plot_confusion(found, tmp_path / "a.gif")
