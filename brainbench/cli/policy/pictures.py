"""Pictures of an environment without a display or OpenGL."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.cli.tactile import figures
from brainbench.stimuli.figures.camera import Camera
from brainbench.stimuli.figures.pictures import Style
from brainbench.stimuli.figures.scenes import write_film
from brainbench.stimuli.figures.surfaces import Triangles

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robotics_bridge.envs import Env

FACES = np.array(
    [
        [0.86, 0.35, 0.29], [0.97, 0.68, 0.57], [0.27, 0.60, 0.42],
        [0.60, 0.82, 0.66], [0.24, 0.45, 0.76], [0.95, 0.80, 0.35],
    ]
)  # fmt: skip
"""Colours of an object's sides (+x, −x, +y, −y, +z, −z of its body), so that its rotation shows."""
HOT, BALL, WOOD = (0.86, 0.30, 0.22), (0.62, 0.72, 0.86), (0.93, 0.90, 0.85)
VIEWS = {"hot_ball": (-0.8, -0.9, 1.3), "screwdriver": (-0.9, 0.9, 0.45)}
"""Direction from the scene to the camera, by task."""
_VIEW = (0.85, -0.75, 0.95)


class Stage:
    """Draws one environment of a batch, of ``size`` (width, height) in pixels; the camera stands still."""

    def __init__(self, env: Env, size: tuple[int, int] = (480, 400), number: int = 0) -> None:
        self._env, self._number = env, number
        self._scene = env.simulation.engine.scene
        self._parts: list[tuple[int, Any]] = []
        focus = []
        for index in range(len(self._scene.geometries)):
            geometry = self._scene.geometry_in(number, index)
            link = self._scene.link_index(geometry.link)
            held = geometry.link in env.model.objects
            if (held and max(geometry.size) < 1e-3) or geometry.kind == "plane":
                continue
            solid = figures.surface(geometry, WOOD if link == 0 else figures.SKIN)
            if held:
                solid = replace(solid, colors=self._object_colors(geometry.link, solid))
            self._parts.append((link, solid))
            focus.append(figures.placed(solid, self._pose()[link]).corners.reshape(-1, 3))
        points = np.concatenate(focus)
        self._lens = Camera(view=VIEWS.get(env.task.name, _VIEW)).lens(points, size).supersampled(figures.SAMPLES)

    def frame(self) -> NDArray[np.uint8]:
        """Return the picture [H, W, 3] of this moment."""
        pose = self._pose()
        solids = Triangles.joined([figures.placed(solid, pose[link]) for link, solid in self._parts])
        image, _, _ = figures.shaded(solids, self._lens, 0.05)
        return (255 * figures.averaged(image)).astype(np.uint8)

    def _pose(self) -> NDArray[np.float64]:
        return self._env.simulation.state.pose_torch[self._number].cpu().numpy().astype(float)

    def _object_colors(self, link: str, solid: Any) -> NDArray[np.float64]:
        if len(self._env.model.objects) > 1:
            hot = self._env.model.objects.index(link) == int(self._env.state.episode.target[self._number])
            return np.tile(np.array(HOT if hot else BALL), (len(solid.corners), 1))
        normal = np.cross(solid.corners[:, 1] - solid.corners[:, 0], solid.corners[:, 2] - solid.corners[:, 0])
        axis = np.abs(normal).argmax(axis=1)
        sign = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] < 0
        return FACES[2 * axis + sign]


def write_video(path: Path, frames: Sequence[NDArray[np.uint8]], size: tuple[int, int], rate: float) -> None:
    """Write frames to an ``.mp4`` or ``.gif``."""
    style, sample = Style(size=size, frames_per_second=rate), frames[:: max(1, len(frames) // 4)]
    write_film(path, frames, style, palette_from=sample)
