"""What a hand file becomes, checked: palm, tips and pads, and a ball pressed into every pad, against the engine."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import BrainbenchError
from robotics_bridge.hands import load_all
from robotics_bridge.hands.hand import Hand
from robotics_bridge.hands.layouts import Layout, active_count
from robotics_bridge.hands.tree import doubts_of, link_points, overlaps

mujoco = mujoco_module()

_RADIUS = 6e-3  # radius of the balls that press (m)
_DEPTH = 3e-4  # depth to which they press (m)
_AWAY = 10.0  # where a ball waits (m)
WRONG = 0.01  # part of a load that taxels may lack without a word
OFF = 1e-4  # how far from its place they may show it without a word (m)


@dataclass(frozen=True)
class HandCheck:
    """What became of one hand."""

    name: str
    file: str
    palm: str = ""
    tips: tuple[str, ...] = ()
    pads: int = 0
    """Links with taxels."""
    taxels: int = 0
    bare: tuple[str, ...] = ()
    """Links of the hand without taxels."""
    pressed: int = 0
    """Pads that a ball could touch."""
    worst: float = 0.0
    """Largest part of a press that the taxels of a pad lack."""
    off: float = 0.0
    """Farthest that the suite says a press may lie from where its taxels show it (m)."""
    unbalanced: tuple[str, ...] = ()
    """Pads whose presses may lie farther off than a sensing radius."""
    errors: tuple[str, ...] = field(default=())
    """What stopped the check, or is wrong."""

    @property
    def passed(self) -> bool:
        """True if every tip has taxels, a ball can press it, and taxels feel what presses them."""
        return not self.errors


def check_file(path: Path, pictures: Path | None = None, resolution: str = "low") -> list[HandCheck]:
    """Check every hand of a URDF or MJCF file; a picture of each goes to a folder."""
    try:
        hands = load_all(path)
    except BrainbenchError as error:
        return [HandCheck(path.name, str(path), errors=(str(error),))]
    return [check_hand(hand, pictures, resolution) for hand in hands]


def check_hand(hand: Hand, pictures: Path | None = None, resolution: str = "low") -> HandCheck:
    """Place taxels on a hand, press a ball on every pad, and compare their sums with the engine's forces."""
    file = str(hand.path)
    try:
        layout = hand.layout(resolution)
        loads = press(hand, layout)
    except BrainbenchError as error:
        return HandCheck(hand.name, file, hand.palm, hand.tips, errors=(str(error),))
    bare = tuple(link for link in hand.links() if link not in layout and link not in hand.couplers)
    errors = [*doubts_of(hand.model, hand.links(), overlaps(hand.model)[1])]
    errors += [f"no taxels on the tip {tip!r}" for tip in hand.tips if tip not in layout]
    errors += [f"no ball can press the tip {tip!r}" for tip in hand.tips if tip in layout and tip not in loads]
    parts, levers = [0.0], [0.0]
    for link, (load, felt, missing, _) in loads.items():
        force, moment = (np.linalg.norm(part) for part in np.split(felt - load, 2))
        whole = np.linalg.norm(load[:3])
        parts.append(float(force / whole))
        levers.append(float(missing[1] / whole))
        # What the suite says is missing is not wrong: the ball also touches where no taxel lies.
        if force - missing[0] > WRONG * whole:
            errors.append(f"taxels of {link!r} lack {force / whole:.0%} of a press, of which nothing tells")
        elif force < WRONG * whole and moment - missing[1] > OFF * whole:
            errors.append(f"taxels of {link!r} show a press {1e3 * moment / whole:.1f} mm off, of which nothing tells")
    if pictures is not None:
        # Files of both kinds may have one name.
        draw(hand, layout, pictures / f"{hand.name}{hand.path.suffix.lower().replace('.', '-')}.png")
    return HandCheck(
        hand.name, file, hand.palm, hand.tips, len(layout), active_count(layout), bare, len(loads), max(parts),
        max(levers), tuple(link for link, numbers in loads.items() if numbers[3]), tuple(errors),
    )  # fmt: skip


def press(hand: Hand, layout: Layout) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray, bool]]:
    """Return link → wrench [6] (N, N·m, link frame) of the engine, sum of its taxels, force and moment [2] that the
    suite misses, and whether it flags the moment.

    A ball is pressed into each pad in turn.

    Links that the ball cannot touch, such as those behind another, are left out.
    """
    from robotics_bridge.physics.engines import MujocoEngine
    from robotics_bridge.sensors import KinematicTaxel, SensorSuite

    spec, data = hand.mjspec(), mujoco.MjData(hand.model)
    mujoco.mj_kinematics(hand.model, data)
    spec.option.gravity = (0, 0, 0)
    names = {}
    for number, (link, probes) in enumerate(layout.items()):
        body = data.body(link)
        turn, active = body.xmat.reshape(3, 3), np.flatnonzero(probes.active)
        middle = probes.position[active].mean(axis=0)
        nearest = active[np.linalg.norm(probes.position[active] - middle, axis=1).argmin()]
        outward = turn @ probes.normal[nearest]
        place = body.xpos + turn @ probes.position[nearest] + outward * (_RADIUS - _DEPTH)
        ball = spec.worldbody.add_body(name=f"press{number}", pos=place)
        ball.add_joint(name=f"press{number}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=outward)
        size = (_RADIUS, 0, 0)
        ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, mass=0.1, contype=0xFFFF, conaffinity=0xFFFF)
        names[link] = f"press{number}"
    model = spec.compile()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        engine = MujocoEngine(model, 1, contacts=400)
        sensors = {
            link: KinematicTaxel(link=link, probes=probes, track=tuple(names.values()), total="engine")
            for link, probes in layout.items()
        }
        suite = SensorSuite(engine.scene, sensors, num_envs=1)
        loads = {}
        for link, name in names.items():
            data = engine.data[0]
            mujoco.mj_resetData(model, data)
            for ball_name in names.values():
                data.joint(ball_name).qpos[0] = 0.0 if ball_name == name else _AWAY
            engine.forward()
            suite.update(engine.state, engine.timestep)
            wrench, six, body = np.zeros(6), np.zeros(6), model.body(link).id
            for index, contact in enumerate(data.contact):
                mujoco.mj_contactForce(model, data, index, six)
                links = [int(model.geom_bodyid[geom]) for geom in contact.geom]
                if sorted(links) == sorted((body, model.body(name).id)):
                    sign = 1.0 if links[1] == body else -1.0
                    force, couple = sign * six.reshape(2, 3) @ contact.frame.reshape(3, 3)
                    lever = contact.pos - data.body(link).xpos
                    wrench += np.concatenate([force, np.cross(lever, force) + couple])
            if np.linalg.norm(wrench[:3]) > 1e-9:
                local = (wrench.reshape(2, 3) @ data.body(link).xmat.reshape(3, 3)).ravel()
                missing = np.array([suite.missing[0, body], suite.missing_moment[0, body]])
                felt = suite.read(link)[0].reshape(-1, 6).sum(dim=0).numpy()
                loads[link] = (local, felt, missing, bool(suite.unbalanced[0]))
    return loads


def draw(hand: Hand, layout: Layout, path: Path) -> None:
    """Draw the taxels of a hand at rest over the corners of its links, from the side of the palm and from beside."""
    from brainbench.core.figures import panels, save_figure

    model, data = hand.model, mujoco.MjData(hand.model)
    mujoco.mj_kinematics(model, data)

    def _world(link: str, points: Any) -> np.ndarray:
        body = data.body(link)
        return 1e3 * (body.xpos + np.asarray(points) @ body.xmat.reshape(3, 3).T)

    figure, axes = panels(1, 2, (6.4, 3.2))
    for axis, (across, up) in zip(axes[0], ((0, 1), (0, 2)), strict=True):
        for number in range(1, model.nbody):
            if len(points := link_points(model, number)):
                corners = _world(model.body(number).name, points)
                axis.scatter(corners[:, across], corners[:, up], s=1, color="0.8", rasterized=True)
        for link, probes in layout.items():
            places = _world(link, probes.position[probes.active])
            axis.scatter(places[:, across], places[:, up], s=4)
        axis.set(xlabel=f"{'xyz'[across]} (mm)", ylabel=f"{'xyz'[up]} (mm)", aspect="equal")
    save_figure(figure, path)
