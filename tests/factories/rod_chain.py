"""A chain of links in dense matrices: what the solver's O(links) passes must agree with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from brainbench.stimuli.engines.rod.kernels import specialize

CAPACITY = 12
AXES = np.eye(3)


def in_double(module: str, **parameters: object):
    """Return a kernel module for double precision."""
    import warp as wp

    wp.init()
    return specialize(module, real=wp.float64, capacity=CAPACITY, **parameters)


def _turn(axis, angle):
    k = np.cross(AXES, axis)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


@dataclass
class DenseChain:
    """Links with two hinges each (about y, then z) on a base that moves. mg, mm, ms, mN."""

    length: np.ndarray
    rest: np.ndarray
    """Angle of each link at rest about z [link]."""
    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    """Axial and transverse [link, 2]."""
    stiffness: np.ndarray
    angle: np.ndarray
    """[link, 2]"""
    rate: np.ndarray
    beta: float = 0.1
    base_turn: np.ndarray = None
    """Unit quaternion (w, x, y, z)."""
    base_twist: np.ndarray = None
    """Angular velocity and velocity [6]."""

    @classmethod
    def random(cls, links=6, seed=0):
        rng = np.random.default_rng(seed)
        turn = rng.normal(size=4)
        return cls(
            length=rng.uniform(0.5, 2, links),
            rest=rng.uniform(-0.2, 0.2, links),
            mass=rng.uniform(0.5, 2, links),
            centre=rng.uniform(0.3, 0.8, links),
            inertia=rng.uniform(0.01, 0.3, (links, 2)),
            stiffness=rng.uniform(1, 20, links),
            angle=rng.uniform(-0.5, 0.5, (links, 2)),
            rate=rng.normal(size=(links, 2)) * 0.2,
            base_turn=turn / np.linalg.norm(turn),
            base_twist=rng.normal(size=6) * 0.2,
        )

    @property
    def links(self):
        return len(self.length)

    def arrays(self):
        """Return the fields of ``ChainArrays``, for one whisker."""
        n, shape = self.links, (CAPACITY, 1, 4)
        build, inertia, taper = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        build[:n, 0] = np.stack([self.length, np.cos(self.rest), np.sin(self.rest), self.mass], axis=1)
        inertia[:n, 0] = np.column_stack([self.centre, self.inertia, self.stiffness])
        radius = np.linspace(0.05, 0.01, n + 1)
        arc = np.concatenate([[0], np.cumsum(self.length)])
        taper[:n, 0] = np.stack([radius[:-1], radius[1:], arc[:-1], self.length], axis=1)
        return {
            "links": np.array([n], dtype=np.int32), "beta": np.array([self.beta]), "friction": np.zeros(1),
            "length": arc[-1:], "build": build, "inertia": inertia, "taper": taper,
        }  # fmt: skip

    def pose(self, time=0.0):
        """Base frame, joints [link + 1, 3], axes [link, 2, 3] and frames [link, 3, 3] a time later at steady rates."""
        w, *v = self.base_turn
        k = np.cross(AXES, v)
        frame = np.eye(3) + 2 * w * k + 2 * k @ k
        spin = self.base_twist[:3]
        speed = np.linalg.norm(spin)
        frame = _turn(spin / speed, speed * time) @ frame if speed else frame
        nodes, axes, frames = [self.base_twist[3:] * time], [], []
        for i in range(self.links):
            frame = frame @ _turn(AXES[2], self.rest[i])
            first = frame[:, 1]
            frame = frame @ _turn(AXES[1], self.angle[i, 0] + self.rate[i, 0] * time)
            second = frame[:, 2]
            frame = frame @ _turn(AXES[2], self.angle[i, 1] + self.rate[i, 1] * time)
            axes.append([first, second])
            frames.append(frame)
            nodes.append(nodes[-1] + frame[:, 0] * self.length[i])
        return np.array(nodes), np.array(axes), np.array(frames)

    def point_jacobian(self, point, link, pose=None):
        """Jacobian [6, 6 + 2 links] of the rotation and translation of a link at a point, by base twist and rates."""
        nodes, axes, _ = pose or self.pose()
        out = np.zeros((6, 6 + 2 * self.links))
        out[:3, :3] = out[3:, 3:6] = np.eye(3)
        out[3:, :3] = -np.cross(AXES, point - nodes[0])
        for i in range(link + 1):
            for k in range(2):
                out[:, 6 + 2 * i + k] = *axes[i, k], *np.cross(axes[i, k], point - nodes[i])
        return out

    def _bodies(self, time=0.0):
        """Jacobian at the centre, and inertia [3, 3], of each link."""
        pose = self.pose(time)
        nodes, _, frames = pose
        for i in range(self.links):
            centre = nodes[i] + frames[i][:, 0] * self.centre[i]
            tensor = frames[i] @ np.diag(self.inertia[i][[0, 1, 1]]) @ frames[i].T
            yield self.point_jacobian(centre, i, pose), tensor

    def mass_matrix(self):
        """Mass matrix [6 + 2 links]² of base and joints."""
        return sum(
            j[:3].T @ tensor @ j[:3] + m * j[3:].T @ j[3:]
            for (j, tensor), m in zip(self._bodies(), self.mass, strict=True)
        )

    def bias(self, step=1e-3):
        """Forces [6 + 2 links] of base and joints at steady rates and a base point that moves straight."""
        speed = np.concatenate([self.base_twist, self.rate.ravel()])

        def momenta(time):
            found = [(j @ speed, tensor) for j, tensor in self._bodies(time)]
            return np.array(
                [np.concatenate([t @ v[:3], m * v[3:]]) for (v, t), m in zip(found, self.mass, strict=True)]
            )

        # Fourth order: exact to 1e-12.
        change = (8 * (momenta(step) - momenta(-step)) - momenta(2 * step) + momenta(-2 * step)) / (12 * step)
        return sum(j.T @ rate for (j, _), rate in zip(self._bodies(), change, strict=True))

    def implicit(self, h):
        """Mass matrix of the joints with springs and dampers at the end of a step, and their forces now."""
        lag = max(self.beta, h)
        k = np.repeat(self.stiffness, 2)
        return self.mass_matrix()[6:, 6:] + np.diag(h * lag * k), -k * (self.angle + lag * self.rate).ravel()
