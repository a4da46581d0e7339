"""What the tree of a model says of hands: palms, fingers with their linkages, and joints that follow others."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import mujoco_module
from robotics_bridge.hands.surface import half_open, link_points, looped_bodies

mujoco = mujoco_module()

_LONGEST = 0.25
"""Way from a palm to where its fingers may fork (m); beyond it another body is a palm of its own, at the end of an arm.
"""


@dataclass(frozen=True)
class Branches:
    """One hand in a model, by body numbers."""

    palm: int
    fingers: dict[int, tuple[int, ...]] = field(default_factory=dict)
    """Tip → its links from palm to tip, with those of its linkage first."""
    couplers: frozenset[int] = frozenset()
    """Links that only move others, as the rods of a linkage: nothing touches them."""


class Tree:
    """The bodies of a compiled model, by parents, joints and loops."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._children: dict[int, list[int]] = {body: [] for body in range(model.nbody)}
        for body in range(1, model.nbody):
            self._children[int(model.body_parentid[body])].append(body)
        self._joints = np.bincount(model.jnt_bodyid[np.isin(model.jnt_type, (2, 3))], minlength=model.nbody)
        # Bodies come after their parents.
        for body in range(model.nbody - 1, 0, -1):
            self._joints[model.body_parentid[body]] += self._joints[body]
        self._data = half_open(model)

    def hands(self) -> list[Branches]:
        """Return the hands, that with most fingers first; empty without joints.

        A palm is a body from which most branches of joints part; of a body and one far below it with two branches or
        more, the one below: arms part from a torso. Without any fork it is the body before the last joint: a fixed jaw,
        with whatever arm below it.
        """
        count = {body: len(self._branches(body)) for body in self._children}
        if max(count.values()) <= 1:
            last = max((body for body in count if count[body]), default=None)
            return [] if last is None else [self._hand(last)]
        forks = [body for body in count if count[body] > 1]
        palms = [body for body in forks if not any(self._outranks(fork, body, count) for fork in forks)]
        palms.sort(key=lambda body: (-count[body], body))
        return [self._hand(body) for body in palms]

    def _outranks(self, fork: int, body: int, count: dict[int, int]) -> bool:
        """Return whether of two forks, one below the other, the first is the palm."""
        if self._is_below(fork, body):
            return count[fork] >= max(count[body], 3) or self._away(fork, body) > _LONGEST
        if self._is_below(body, fork):
            return not (count[body] >= max(count[fork], 3) or self._away(fork, body) > _LONGEST)
        return False

    def _away(self, first: int, second: int) -> float:
        return float(np.linalg.norm(self._data.xpos[first] - self._data.xpos[second]))

    def _is_below(self, body: int, above: int) -> bool:
        while body:
            body = int(self._model.body_parentid[body])
            if body == above:
                return True
        return False

    def _branches(self, body: int) -> list[int]:
        return [child for child in self._children[body] if self._joints[child]]

    def _hand(self, palm: int) -> Branches:
        chains = [chain for start in self._branches(palm) for chain in self._chains(start, ())]
        loops = looped_bodies(self._model)
        groups: list[list[tuple[int, ...]]] = []
        for chain in chains:
            joined = [group for group in groups if any(_meet(chain, each, loops) for each in group)]
            groups = [group for group in groups if group not in joined]
            groups.append([each for group in joined for each in group] + [chain])
        groups.sort(key=lambda group: min(chain[0] for chain in group))
        fingers, couplers = {}, set[int]()
        for group in groups:
            # What moves the tip of a linkage reaches less far than the tip.
            group.sort(key=lambda chain: self._reach(chain[-1], palm))
            *others, chain = group
            rods = [body for rod in others for body in rod if body not in chain]
            couplers |= {*rods}
            fingers[chain[-1]] = (*rods, *chain)
        return Branches(palm, fingers, frozenset(couplers))

    def _chains(self, start: int, before: tuple[int, ...]) -> list[tuple[int, ...]]:
        """Return the chains of links with geometry from a body on, one to each tip; forks belong to the first."""
        model, chain, body = self._model, [start], start
        while following := [
            child for child in self._children[body] if self._joints[child] or model.body_geomnum[child]
        ]:
            jointed = [child for child in following if self._joints[child]]
            if len(jointed) > 1:
                ends = [each for child in jointed for each in self._chains(child, ())]
                ends.sort(key=lambda each: -len(each))
                shared = self._with_pads((*before, *chain))
                return [(*shared, *ends[0]), *ends[1:]]
            body = max(following, key=lambda child: (self._joints[child], model.body_geomnum[child]))
            chain.append(body)
        return [self._with_pads((*before, *chain)) or (chain[-1],)]

    def _with_pads(self, chain: tuple[int, ...]) -> tuple[int, ...]:
        """Return a chain with pads that are fixed beside it, each after its parent, without bodies of no geometry."""
        every = [chain[0]]
        for body, parent in zip(chain[1:], chain, strict=False):
            every += [c for c in self._children[parent] if c not in chain and not self._joints[c]] + [body]
        return tuple(body for body in every if self._model.body_geomnum[body])

    def _reach(self, body: int, palm: int) -> float:
        points = link_points(self._model, body)
        if not len(points):
            return 0.0
        world = self._data.xpos[body] + points @ self._data.xmat[body].reshape(3, 3).T
        return float(np.linalg.norm(world - self._data.xpos[palm], axis=1).max())

    @cached_property
    def followers(self) -> frozenset[int]:
        """Joints whose position follows from others: those of couplings, and of loops all but one each."""
        model = self._model
        servos = driven(model)
        leading = {joint for joint in servos if joint >= 0}
        follow = {
            leader if follower in leading and leader not in leading else follower
            for follower, leader, _ in coupled(model)
            if not {follower, leader} <= leading
        }
        for loop in looped_bodies(model):
            joints = [joint for joint in range(model.njnt) if model.jnt_bodyid[joint] in loop]
            first = next((joint for joint in joints if joint in leading), None)
            if first is None and not any(joint in follow for joint in joints):
                first = next(iter(joints), None)
            follow |= {joint for joint in joints if joint != first and joint not in leading}
        return frozenset(follow)


def _meet(first: Iterable[int], second: Iterable[int], loops: list[frozenset[int]]) -> bool:
    return any(loop & {*first} and loop & {*second} for loop in loops)


def coupled(model: Any) -> list[tuple[int, int, NDArray[np.float64]]]:
    """Return (joint, the one that it follows, coefficients [5] of its law) of the equality constraints of two joints.

    The law is MuJoCo's: y − y₀ = a₀ + a₁ (x − x₀) + … + a₄ (x − x₀)⁴.
    """
    joints = (model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_obj2id >= 0) & (model.eq_active0 != 0)
    rows = np.flatnonzero(joints).tolist()
    return [(int(model.eq_obj1id[row]), int(model.eq_obj2id[row]), model.eq_data[row, :5]) for row in rows]


@dataclass(frozen=True)
class Drive:
    """A position servo of a file: the joint that leads, and the tendon by which it pulls others along."""

    actuator: int
    tendon: int = -1
    """Fixed tendon; −1: the joint alone."""
    coefficient: float = 1.0
    """Of the leading joint in the tendon."""
    total: float = 1.0
    """Sum of all coefficients as if the joints moved alike: of the tendon's length by the leading joint."""


def driven(model: Any) -> dict[int, Drive]:
    """Return leading joint → its position servo, of joints and of tendons over joints, in the order of the file."""
    drives: dict[int, Drive] = {}
    for index in range(model.nu):
        if model.actuator_biasprm[index, 1] >= 0:
            continue
        kind, target = int(model.actuator_trntype[index]), int(model.actuator_trnid[index, 0])
        if kind == int(mujoco.mjtTrn.mjTRN_JOINT):
            drives.setdefault(target, Drive(index))
        elif kind == int(mujoco.mjtTrn.mjTRN_TENDON):
            first, count = int(model.tendon_adr[target]), int(model.tendon_num[target])
            wraps = range(first, first + count)
            if (model.wrap_type[first : first + count] == mujoco.mjtWrap.mjWRAP_JOINT).all():
                factors = {int(model.wrap_objid[wrap]): float(model.wrap_prm[wrap]) for wrap in wraps}
                leader = next(iter(factors))
                total = float(sum(abs(factor) for factor in factors.values()))
                drives.setdefault(leader, Drive(index, target, factors[leader], total))
    return drives


def pulled(model: Any) -> frozenset[int]:
    """Return the joints that a tendon of :func:`driven` moves, but for its leading one."""
    joints = set[int]()
    for leader, drive in driven(model).items():
        if drive.tendon >= 0:
            first = int(model.tendon_adr[drive.tendon])
            wraps = model.wrap_objid[first : first + int(model.tendon_num[drive.tendon])]
            joints |= {int(joint) for joint in wraps} - {leader}
    return frozenset(joints)
