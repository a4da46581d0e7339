from __future__ import annotations

import sys
from pathlib import Path

import pytest

from brainbench.core.errors import MissingDependencyError
from tests.factories.policy_commands import run_policy


def test_a_film_that_cannot_be_written_is_told_before_anything_plays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr("brainbench.cli.policy.options.World.make", lambda *_, **__: pytest.fail("it was begun"))
    with pytest.raises(MissingDependencyError, match="imageio-ffmpeg"):
        run_policy("play", "in_palm_rotate", "--agent", "zero", "--video", str(tmp_path / "turn.mp4"))
