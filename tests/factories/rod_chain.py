"""A chain of links in MuJoCo's dense matrices: what the solver's O(links) passes must agree with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from brainbench.core.devices import mujoco_module
from brainbench.stimuli.engines.rod.kernels import specialize

mujoco = mujoco_module()

CAPACITY = 12


def in_double(module: str, **parameters: object):
    """Return a kernel module for double precision."""
    import warp as wp

    wp.init()
    return specialize(module, real=wp.float64, capacity=CAPACITY, **parameters)


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
            inertia=np.sort(rng.uniform(0.01, 0.3, (links, 2))),
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

    def _engine(self) -> tuple[Any, Any, np.ndarray]:
        """Return MuJoCo's model and state of this chain, and its velocities per twist of the base and rates."""
        text, hinges = "", '<joint axis="0 1 0"/><joint axis="0 0 1"/>'
        for i, start in enumerate([0.0, *self.length[:-1]]):
            bend, turns = (self.rest[i] / 2, self.rest[i] / 2) if self.torsion[i] > 0 else (self.rest[i], 0.0)
            more = '<joint axis="1 0 0"/>' if self.torsion[i] > 0 else ""
            axial, transverse = self.inertia[i]
            text += f'<body pos="{start} 0 0" euler="0 0 {bend}">{hinges}{more}<body name="{i}" euler="0 0 {turns}">'
            text += f'<inertial mass="{self.mass[i]}" pos="{self.centre[i]} 0 0" '
            text += f'diaginertia="{axial} {transverse} {transverse}"/>'
        text += "</body></body>" * self.links
        model = mujoco.MjModel.from_xml_string(
            '<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody><body><freejoint/>'
            f'<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>{text}</body></worldbody></mujoco>'
        )
        data = mujoco.MjData(model)
        data.qpos[3:] = [*self.base_quaternion, *self.angle[self.free]]
        mujoco.mj_kinematics(model, data)
        change = np.eye(model.nv)
        # The base's velocity stands first there, and its spin in its own axes.
        change[:6, :6] = np.block([[np.zeros((3, 3)), np.eye(3)], [data.xmat[1].reshape(3, 3).T, np.zeros((3, 3))]])
        data.qvel[:] = change @ [*self.base_twist, *self.rate[self.free]]
        mujoco.mj_forward(model, data)
        return model, data, change

    @property
    def nodes(self):
        """Joints and tip [link + 1, 3]."""
        _, data, _ = self._engine()
        links = [data.body(str(i)) for i in range(self.links)]
        tip = links[-1].xpos + links[-1].xmat.reshape(3, 3)[:, 0] * self.length[-1]
        return np.array([*(link.xpos for link in links), tip])

    def point_jacobian(self, point, link):
        """Jacobian [6, 6 + hinges] of the rotation and translation of a link at a point, by base twist and rates."""
        model, data, change = self._engine()
        moved, turned = np.zeros((2, 3, model.nv))
        mujoco.mj_jac(model, data, moved, turned, point, model.body(str(link)).id)
        return np.concatenate([turned, moved]) @ change

    def mass_matrix(self):
        """Mass matrix [6 + hinges]² of base and joints."""
        model, data, change = self._engine()
        mass = np.zeros((model.nv, model.nv))
        for row, motion in zip(mass, change.T, strict=True):
            mujoco.mj_mulM(model, data, row, np.ascontiguousarray(motion))
        # MuJoCo's base has a mass and inertia of its own, 1.
        return mass @ change - np.diag(np.arange(model.nv) < 6)

    def bias(self):
        """Forces [6 + hinges] of base and joints at steady rates and a base point that moves straight."""
        _, data, change = self._engine()
        return change.T @ data.qfrc_bias

    def implicit(self, h):
        """Mass matrix of the joints with springs and dampers at the end of a step, and their forces now."""
        lag = max(self.beta, h)
        k = np.column_stack([self.stiffness, self.stiffness, self.torsion])[:, : self.hinges][self.free]
        return self.mass_matrix()[6:, 6:] + np.diag(h * lag * k), -k * (self.angle + lag * self.rate)[self.free]
