from __future__ import annotations

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from brainbench.cli import app
from brainbench.core.errors import MissingDependencyError


def _run(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["policy", *arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_a_film_that_cannot_be_written_is_told_before_anything_plays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr("brainbench.cli.policy.options.World.make", lambda *_, **__: pytest.fail("it was begun"))
    with pytest.raises(MissingDependencyError, match="imageio-ffmpeg"):
        _run("play", "in_palm_rotate", "--agent", "zero", "--video", str(tmp_path / "turn.mp4"))
