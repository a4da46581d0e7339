"""Jobs as scene files, so that the public command simulates scenes that were drawn in Python."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from brainbench.core.errors import UsageError
from brainbench.core.rotations import to_matrices
from brainbench.stimuli.motion.jobs import MILLI, Job
from brainbench.stimuli.motion.trajectories import ArrayFollicle, Translation, Whisking
from brainbench.stimuli.objects.obstacle import Box, Capsule, Obstacle, Part, Sphere

KEYFRAME = 1.25e-3
"""Time between keyframes of a motion that a scene file has no words for [s]."""


def write_scene(job: Job, folder: Path) -> Path:
    """Write a scene file with whisker, motions, objects and readings of a job into a new folder; return its path."""
    folder.mkdir(parents=True)
    whisker, whisking = job.whisker, {"kind": "still"}
    name, position, euler = "C2", (0.0, 0.0, 0.0), job.follicle.pose(job.times[:1])[1][0]
    if isinstance(job.follicle, ArrayFollicle):
        mount, motion = job.follicle.mount, job.follicle.whisking
        if not isinstance(motion, Whisking):
            raise UsageError(f"Only sinusoidal whisking is written into scene files; received {motion!r}.")
        name, position, euler = mount.name, mount.position, mount.angles
        angles = {f"{key}_deg": np.degrees(getattr(motion, key)) for key in ("protraction", "retraction")}
        whisking = {"frequency_hz": motion.frequency, "onset_ms": MILLI * motion.onset, **angles}
    rod = {field.name: getattr(whisker, field.name) for field in fields(whisker)}
    given = {key: value for key, value in rod.items() if value not in ((), None)}
    mounted = {"name": name, "position_mm": MILLI * np.array(position), "angles_deg": np.degrees(euler)}
    _write(folder / "whisker.toml", {"species": "one whisker", "mount": [{**mounted, "whisker": given}]})
    objects = [each for obstacle in job.obstacles for each in _objects(obstacle, job.times[-1], folder)]
    frames = {"first_ms": MILLI * job.times[0], "interval_ms": MILLI * job.spacing, "count": len(job.times)}
    scene = {"array": {"species": "whisker.toml"}, "whisking": whisking, "frames": frames, "object": objects}
    return _write(folder / "scene.toml", {**scene, "scene": [{"label": "scene"}]})


def _objects(obstacle: Obstacle, end: float, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield a table for each body of an obstacle; those that move keep their direction."""
    moving: dict[str, Any] = {} if obstacle.friction is None else {"friction": obstacle.friction}
    motion = obstacle.motion and getattr(obstacle.motion, "motion", None)
    if isinstance(motion, Translation):
        moving |= {"velocity_mm_s": MILLI * np.array(motion.velocity), "velocity_onset_ms": MILLI * motion.onset}
    elif obstacle.motion is not None:
        times = np.arange(0.0, end + 0.02, KEYFRAME)
        moving |= {"times_ms": MILLI * times, "path_mm": MILLI * obstacle.motion(times)[0]}
    if obstacle.surface is None:
        yield from ({**_primitive(part), **moving} for part in obstacle.parts)
        return
    vertices, faces = obstacle.surface.vertices, obstacle.surface.faces + 1
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()] + [f"f {a} {b} {c}" for a, b, c in faces.tolist()]
    (folder / "surface.obj").write_text("\n".join(rows) + "\n", encoding="utf-8")
    yield {"shape": "mesh", "path": "surface.obj", "unit": "m", "collision": "exact", **moving}


def _primitive(part: Part) -> dict[str, Any]:
    if isinstance(part, Sphere):
        return {"shape": "sphere", "radius_mm": MILLI * part.radius, "position_mm": MILLI * np.array(part.centre)}
    if isinstance(part, Box):
        turn, middle = Rotation.from_matrix(to_matrices(part.quaternion)), np.array(part.centre)
        shape: dict[str, Any] = {"shape": "box", "size_mm": 2 * MILLI * np.array(part.half_sizes)}
    elif isinstance(part, Capsule):
        ends = np.array([part.start, part.end])
        way, middle = ends[1] - ends[0], ends.mean(axis=0)
        turn = Rotation.align_vectors(way[None], [[0.0, 0.0, 1.0]])[0]
        shape = {"shape": "capsule", "radius_mm": MILLI * part.radius, "length_mm": MILLI * np.linalg.norm(way)}
    else:
        raise UsageError(f"Only spheres, boxes and capsules are written into scene files; received {part!r}.")
    return {**shape, "position_mm": MILLI * middle, "rotation_deg": turn.as_euler("xyz", degrees=True)}


def _write(path: Path, table: dict[str, Any]) -> Path:
    path.write_text("".join(f"{key} = {_toml(value)}\n" for key, value in table.items()), encoding="utf-8")
    return path


def _toml(value: Any) -> str:
    """Return a value as TOML; tables stand in one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, (list, tuple, np.ndarray)):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value.item() if isinstance(value, np.generic) else value)
