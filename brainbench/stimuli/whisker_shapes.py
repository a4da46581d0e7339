"""The shapes of whiskers over time, and the bending moments along them.

A stimulus set holds forces only; shapes are simulated when a picture asks for them, up to the last
instant it shows, and kept in the cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError
from brainbench.core.progress import Progress
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.engines.protocol import WhiskerEngine
from brainbench.stimuli.motion.jobs import Job
from brainbench.stimuli.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class Recording:
    """Shapes of the whiskers of one scene. Letters: n instant, N link."""

    scene: Scene
    times: NDArray[np.float64]
    """[n] s."""
    joints: tuple[NDArray[np.float64], ...]
    """Per whisker [n, N + 1, 3]: joints and tip (m, world); NaN from where its simulation became unstable."""
    moments: tuple[NDArray[np.float64], ...]
    """Per whisker [n, N + 1]: elastic bending moment at the joints and the tip (N·m, without sign)."""

    @property
    def unstable(self) -> tuple[str, ...]:
        """Names of the whiskers whose shape is not known at every instant."""
        pairs = zip(self.scene.names, self.joints, strict=True)
        return tuple(name for name, points in pairs if not np.isfinite(points).all())

    def unbent(self, whisker: int, instant: int) -> NDArray[np.float64]:
        """Return joints and tip [N + 1, 3] (m, world) of a whisker that nothing bends, at one instant."""
        from brainbench.core.rotations import base_rotation
        from brainbench.stimuli.whiskers.chain import build_chain

        job, axes = self.scene.jobs()[whisker], self.scene.axes[whisker]
        place, euler = job.follicle.pose(self.times[instant : instant + 1])
        rest = np.pad(build_chain(job.whisker, self.joints[whisker].shape[1] - 1).points, ((0, 0), (0, 1)))
        return (rest @ base_rotation(euler)[0].T + place[0]) @ axes.T + self.scene.origins[whisker]


def record(
    scene: Scene,
    times: ArrayLike,
    *,
    fidelity: Fidelity | str | None = None,
    backend: WhiskerEngine | str = DEFAULT_ENGINE,
    progress: Progress | None = None,
    cache: bool = True,
) -> Recording:
    """Simulate a scene and return the shapes of its whiskers.

    Args:
        scene: what to simulate; its frames do not matter.
        times: instants [n] (s), increasing, not before t = 0.
        fidelity, backend, progress, cache: as for :func:`brainbench.stimuli.simulate`; shapes have a cache of their
            own.
    """
    from brainbench.stimuli.simulation import cache_path, resolve

    times = np.atleast_1d(np.asarray(times, dtype=float))
    engine, fidelity = resolve(backend, fidelity, [scene])
    jobs = [replace(job, times=times) for job in scene.jobs()]
    path = None
    if cache and isinstance(backend, str):
        path = cache_path([scene], fidelity, engine, times, folder="shapes").with_suffix(".npz")
    names = [f"whisker{index}" for index in range(len(jobs))]
    stored = None if path is None else read_sealed(path, "shapes of whiskers")
    if stored is not None:
        local: list[NDArray[np.float64]] = [stored[name].astype(float) for name in names]
    else:
        local = _simulate(jobs, fidelity, engine, progress)
        if path is not None:
            write_sealed(path, "shapes of whiskers", dict(zip(names, local, strict=True)), compress=True)
    moments = tuple(bending_moments(job, points) for job, points in zip(jobs, local, strict=True))
    # Jobs stand in the frame of their array as it was at t = 0.
    places = zip(local, scene.axes, scene.origins, strict=True)
    joints = tuple(points @ axes.T + origin for points, axes, origin in places)
    return Recording(scene, times, joints, moments)


def bending_moments(job: Job, joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the elastic moment [n, N + 1] (N·m) at each joint of a chain; zero at the tip.

    The moment is the hinge's stiffness times the angle by which the link after the joint is turned from its rest
    direction (:mod:`brainbench.stimuli.whiskers.chain`); damping and twist carry none of it. ``joints`` are [n, N + 1,
    3] (m) in the frame of the job, at its times [n].
    """
    from brainbench.core.rotations import base_rotation
    from brainbench.stimuli.whiskers.chain import build_chain

    links = joints.shape[1] - 1
    chain = build_chain(job.whisker, links)
    along = np.diff(joints, axis=1)
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    frame = base_rotation(job.follicle.pose(job.times)[1])
    moments = np.zeros(joints.shape[:2])
    for link in range(links):
        cosine, sine = np.cos(chain.rest_angles[link]), np.sin(chain.rest_angles[link])
        frame = frame @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        # Turned by a about y and b about z, the x axis is (cos a cos b, sin b, −sin a cos b).
        x, y, z = np.moveaxis(np.einsum("nji,nj->ni", frame, along[:, link]), -1, 0)
        about_y, about_z = np.arctan2(-z, x), np.arctan2(y, np.hypot(x, z))
        moments[:, link] = chain.stiffness[link] * np.hypot(about_y, about_z)
        # The new link's axes: x along it, turned by the hinges about y and z without twist.
        across = np.stack([-np.cos(about_y) * np.sin(about_z), np.cos(about_z), np.sin(about_y) * np.sin(about_z)], -1)
        second = np.einsum("nij,nj->ni", frame, across)
        frame = np.stack([along[:, link], second, np.cross(along[:, link], second)], axis=-1)
    if job.whisker.follicle is not None:  # the turn of the first joint is that of the follicle too
        moments[:, 0] = 2 * moments[:, 1] - moments[:, 2]
    return moments


def _simulate(
    jobs: Sequence[Job], fidelity: Fidelity, engine: WhiskerEngine, progress: Progress | None
) -> list[NDArray[np.float64]]:
    report = None if progress is None else lambda done, total: progress(done, total, "simulating shapes")
    traces = engine.run(jobs, fidelity, progress=report, record_shape=True)
    shapes: list[Any] = [trace.link_positions for trace in traces]
    if any(shape is None for shape in shapes):
        raise UsageError(
            f"The backend {engine.name!r} reports no whisker shapes, so nothing can be drawn; use 'rod' or 'mujoco'."
        )
    return shapes
