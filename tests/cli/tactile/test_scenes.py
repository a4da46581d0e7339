from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from brainbench.cli.tactile import scenes
from brainbench.core.errors import MissingDependencyError
from brainbench.stimuli.figures.surfaces import Triangles
from tests.factories.policies import run_policy


def test_triangles_of_a_link_are_carried_with_it():
    corners = np.array([[[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]])
    flat = Triangles(corners, np.tile([1.0, 0, 0], (1, 3, 1)), np.ones((1, 3)))
    half = np.sqrt(0.5)
    # A quarter turn about z, then one metre up.
    moved = scenes.placed(flat, np.array([0, 0, 1, 0, 0, half, half]))
    np.testing.assert_allclose(moved.corners[0], [[0, 1, 1], [-1, 0, 1], [0, 0, 2]], atol=1e-12)
    np.testing.assert_allclose(moved.normals[0], [[0, 1, 0]] * 3, atol=1e-12)


def test_a_supersampled_picture_is_averaged_to_its_own_size():
    fine = np.zeros((2 * scenes.SAMPLES, 3 * scenes.SAMPLES, 3))
    fine[0, 0] = 1.0
    small = scenes.averaged(fine)
    assert small.shape == (2, 3, 3)
    np.testing.assert_allclose(small[0, 0], 1 / scenes.SAMPLES**2)
    assert not small[1:].any()


def test_white_borders_are_cut_to_a_margin():
    image = np.ones((50, 60, 3))
    image[20:30, 40:45] = 0.2
    assert scenes._trimmed(image, margin=3).shape == (16, 11, 3)
    assert scenes._trimmed(np.ones((50, 60, 3))).shape == (50, 60, 3)


@pytest.mark.parametrize("moved", [0.0, 1e-3])
def test_markers_are_drawn_whether_they_moved_or_not(tmp_path, moved):
    rest = np.stack([*np.meshgrid(np.linspace(0, 0.01, 4), np.linspace(0, 0.01, 4)), np.zeros((4, 4))], -1)
    field = np.full((16, 3), moved)
    scenes.draw_markers(tmp_path / "m.png", rest.reshape(-1, 3), {"press": field, "drag": field})
    assert (tmp_path / "m.png").read_bytes().startswith(b"\x89PNG")


def test_a_film_that_cannot_be_written_is_told_before_anything_plays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr("brainbench.cli.policy.train.World.make", lambda *_, **__: pytest.fail("it was begun"))
    with pytest.raises(MissingDependencyError, match="imageio-ffmpeg"):
        run_policy("play", "in_palm_rotate", "--agent", "zero", "--video", str(tmp_path / "turn.mp4"))


@pytest.mark.slow
def test_demo_writes_four_pictures_of_a_hand_that_feels_something(run, tmp_path):
    found = run("tactile", "demo", "--out", str(tmp_path), "--resolution", "low", "--json")
    assert found.status == 0, found.err
    made = json.loads(found.out)
    assert made["forces"]["in contact"] > 3
    assert made["temperature"]["aluminium (°C)"] > made["temperature"]["wood (°C)"] > 22
    for name in ("forces", "markers", "temperature", "sound"):
        assert (tmp_path / f"tactile-{name}.png").stat().st_size > 10_000
