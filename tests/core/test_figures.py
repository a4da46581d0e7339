"""The look of charts: equal charts are equal files, formats are checked, logarithmic axes have plain numbers."""

from __future__ import annotations

from pathlib import Path

import pytest

from brainbench.core.errors import UsageError
from brainbench.core.figures import INK, check_format, new_figure, panels, save_figure


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_equal_charts_are_equal_files(tmp_path, suffix):
    written = []
    for name in ("a", "b"):
        figure, axes = panels(1, 1, (2, 1.5))
        axes[0, 0].plot([1, 2], [3, 4])
        written.append(save_figure(figure, tmp_path / f"{name}.{suffix}").read_bytes())
    assert written[0] == written[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"a.{suffix}", f"b.{suffix}"]


def test_a_chart_that_cannot_be_drawn_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    with pytest.raises(TypeError):
        save_figure(new_figure(100, 100), path, no_such_option=1)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_panels_have_the_size_that_was_asked_for_and_the_common_style():
    figure, axes = panels(2, 3, (6, 4))
    assert axes.shape == (2, 3)
    assert figure.get_size_inches().tolist() == [6, 4]
    assert {panel.title.get_color() for panel in axes.flat} == {INK}
    assert not any(panel.spines["top"].get_visible() for panel in axes.flat)


def test_a_format_is_told_by_the_ending_of_the_name():
    assert check_format(Path("A.PNG"), [".png", ".svg"]) == ".png"
    with pytest.raises(UsageError, match=r"'\.pgn'; did you mean '\.png'"):
        check_format(Path("a.pgn"), [".png", ".svg"])
    with pytest.raises(UsageError, match=r"Unknown format of a picture 'chart'\. Allowed: '\.png', '\.svg'"):
        check_format(Path("chart"), [".png", ".svg"])
