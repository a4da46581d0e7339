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


def _records(**columns):
    records = np.zeros((CAPACITY, 1), dtype=[(name, float) for name in columns])
    for name, values in columns.items():
        records[name][: len(values), 0] = values
    return records


@dataclass
class DenseChain:
    """Links with two hinges each (about y, then z) on a base that moves. mg, mm, ms, mN.

    With three ``hinges`` links 1, 3, 5 … also twist, between two halves of their rest bend.
    """

    length: np.ndarray
    rest: np.ndarray
    """Angle of each link at rest about z [link]."""
    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    """Axial and transverse [link, 2]."""
    stiffness: np.ndarray
    angle: np.ndarray
    """[link, hinge]; zero where there is no hinge, as rates are."""
    rate: np.ndarray
    torsion: np.ndarray
    beta: float = 0.1
    base_quaternion: np.ndarray = None
    """Unit quaternion (w, x, y, z)."""
    base_twist: np.ndarray = None
    """Angular velocity and velocity [6]."""

    @classmethod
    def random(cls, links=6, seed=0, hinges=2):
        rng = np.random.default_rng(seed)
        turn = rng.normal(size=4)
        made = cls(
            length=rng.uniform(0.5, 2, links),
            rest=rng.uniform(-0.2, 0.2, links),
            mass=rng.uniform(0.5, 2, links),
            centre=rng.uniform(0.3, 0.8, links),
            inertia=rng.uniform(0.01, 0.3, (links, 2)),
            stiffness=rng.uniform(1, 20, links),
            angle=rng.uniform(-0.5, 0.5, (links, 2)),
            rate=rng.normal(size=(links, 2)) * 0.2,
            base_quaternion=turn / np.linalg.norm(turn),
            base_twist=rng.normal(size=6) * 0.2,
            torsion=np.zeros(links),
        )
        if hinges == 3:
            made.torsion[1::2] = rng.uniform(1, 20, links // 2)
            angle, rate = rng.uniform(-0.5, 0.5, links), rng.normal(size=links) * 0.2
            turns = made.torsion > 0
            made.angle, made.rate = np.c_[made.angle, turns * angle], np.c_[made.rate, turns * rate]
        return made

    @property
    def links(self):
        return len(self.length)

    @property
    def hinges(self):
        return self.angle.shape[1]

    @property
    def free(self):
        """Which angles are hinges [link, hinge]."""
        return np.column_stack([np.ones((self.links, 2), dtype=bool), self.torsion > 0])[:, : self.hinges]

    @property
    def axes_count(self):
        return np.count_nonzero(self.free)

    def arrays(self):
        """Return the fields of ``ChainArrays``, for one whisker."""
        n = self.links
        rest = np.where(self.torsion > 0, self.rest / 2, self.rest)
        springs = {"stiffness": self.stiffness, "torsion": self.torsion}
        if self.hinges == 2:
            del springs["torsion"]
        radius = np.linspace(0.05, 0.01, n + 1)
        arc = np.concatenate([[0], np.cumsum(self.length)])
        build = _records(length=self.length, bend_cosine=np.cos(rest), bend_sine=np.sin(rest), mass=self.mass)
        axial, transverse = self.inertia.T
        inertia = _records(centre=self.centre, axial=axial, transverse=transverse, **springs)
        taper = _records(start_radius=radius[:-1], end_radius=radius[1:], arc=arc[:-1], arc_length=self.length)
        return {
            "links": np.array([n], dtype=np.int32), "beta": np.array([self.beta]), "friction": np.zeros(1),
            "length": arc[-1:], "build": build, "inertia": inertia, "taper": taper,
        }  # fmt: skip

    def pose(self, time=0.0):
        """Base frame, joints [link + 1, 3], axes (a list [hinge, 3] per link) and frames [link, 3, 3], a time later."""
        w, *v = self.base_quaternion
        k = np.cross(AXES, v)
        frame = np.eye(3) + 2 * w * k + 2 * k @ k
        spin = self.base_twist[:3]
        speed = np.linalg.norm(spin)
        frame = _turn(spin / speed, speed * time) @ frame if speed else frame
        nodes, axes, frames = [self.base_twist[3:] * time], [], []
        for i in range(self.links):
            half = self.rest[i] / 2 if self.torsion[i] > 0 else 0.0
            frame = frame @ _turn(AXES[2], self.rest[i] - half)
            first = frame[:, 1]
            frame = frame @ _turn(AXES[1], self.angle[i, 0] + self.rate[i, 0] * time)
            second = frame[:, 2]
            frame = frame @ _turn(AXES[2], self.angle[i, 1] + self.rate[i, 1] * time)
            axes.append([first, second])
            if half:
                axes[-1].append(frame[:, 0])
                frame = frame @ _turn(AXES[0], self.angle[i, 2] + self.rate[i, 2] * time) @ _turn(AXES[2], half)
            frames.append(frame)
            nodes.append(nodes[-1] + frame[:, 0] * self.length[i])
        return np.array(nodes), axes, np.array(frames)

    def point_jacobian(self, point, link, pose=None):
        """Jacobian [6, 6 + hinges] of the rotation and translation of a link at a point, by base twist and rates."""
        nodes, axes, _ = pose or self.pose()
        out = np.zeros((6, 6 + self.axes_count))
        out[:3, :3] = out[3:, 3:6] = np.eye(3)
        out[3:, :3] = -np.cross(AXES, point - nodes[0])
        column = 6
        for i in range(link + 1):
            for axis in axes[i]:
                out[:, column] = *axis, *np.cross(axis, point - nodes[i])
                column += 1
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
        """Mass matrix [6 + hinges]² of base and joints."""
        return sum(
            j[:3].T @ tensor @ j[:3] + m * j[3:].T @ j[3:]
            for (j, tensor), m in zip(self._bodies(), self.mass, strict=True)
        )

    def bias(self, step=1e-3):
        """Forces [6 + hinges] of base and joints at steady rates and a base point that moves straight."""
        speed = np.concatenate([self.base_twist, self.rate[self.free]])

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
        k = np.column_stack([self.stiffness, self.stiffness, self.torsion])[:, : self.hinges][self.free]
        return self.mass_matrix()[6:, 6:] + np.diag(h * lag * k), -k * (self.angle + lag * self.rate)[self.free]
