"""Faults of issue 22 measured on an earlier tree and on this one, and what must add up, as two tables.

    python -m benchmarks.tactile.faults --before FOLDER --write

``FOLDER`` holds an earlier tree: ``git archive 583c5b5e | tar -x -C FOLDER``. The same lines of this file run in both.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from robotics_bridge import hands
from robotics_bridge.physics import Geometry, HandState, TouchScene
from robotics_bridge.sensors import (
    ContactAudio,
    ContactDepthProbe,
    KinematicTaxel,
    Noise,
    Probes,
    SensorSuite,
    SurfaceDistanceProbe,
    TemperatureGrid,
)
from robotics_bridge.sensors.audio.materials import Modes

PAD = Geometry(name="pad", link="hand", kind="box", size=(0.02, 0.02, 0.005))
TOP = Probes.grid(14, 14, size=(0.036, 0.036), center=(0, 0, 0.005), radius=0.002)
GRIPPER = """<mujoco><worldbody><body name="base"><geom type="box" size=".03 .06 .02"/>
<body name="left" pos="0 0 .06"><joint name="l" type="slide" axis="0 1 0" range="0 .04"/>
<geom type="box" size=".01 .005 .02" pos="0 .005 0"/></body>
<body name="right" pos="0 0 .06" quat="0 0 0 1"><joint name="r" type="slide" axis="0 1 0" range="0 .04"/>
<geom type="box" size=".01 .005 .02" pos="0 .005 0"/></body></body></worldbody></mujoco>"""


def scene_of(*objects: Geometry) -> TouchScene:
    """A pad on link ``hand``, its top at z = 5 mm, and objects on links of their own."""
    return TouchScene(("world", "hand", *(g.link for g in objects)), (PAD, *objects))


def state_of(scene: TouchScene, places: list[tuple], contacts: int = 8, turn: tuple = (1, 0, 0, 0)) -> HandState:
    """A state in which objects lie at places (m)."""
    state = HandState.empty(1, len(scene.links), contacts)
    pose = np.zeros((len(scene.links), 7))
    pose[:, 3] = 1
    for number, place in enumerate(places):
        pose[2 + number] = [*place, *turn]
    state.set_pose(pose)
    return state


def reading(scene: TouchScene, state: HandState, sensor: Any, updates: int = 1) -> np.ndarray:
    """What one sensor reads, probe by probe."""
    suite = SensorSuite(scene, {"s": sensor}, num_envs=1)
    for _ in range(updates):
        suite.update(state, 0.01)
    return suite.read("s")[0].numpy().reshape(-1, max(sensor.channels, 1)).astype(float)


def ball(name: str = "ball", radius: float = 0.01) -> Geometry:
    """A ball on a link of its own."""
    return Geometry(name=name, link=name, kind="sphere", size=(radius,))


def both_faces() -> Probes:
    """Taxels on both faces of the pad."""
    low = Probes.grid(14, 14, size=(0.036, 0.036), center=(0, 0, -0.005), normal=(0, 0, -1), radius=0.002)
    parts = [[np.reshape(getattr(p, n), s) for p in (TOP, low)] for n, s in
             (("position", (-1, 3)), ("normal", (-1, 3)), ("radius", -1))]  # fmt: skip
    return Probes(*(np.concatenate(part) for part in parts))


def pinched() -> str:
    """Read a link that two balls press with 10 N from both sides."""
    scene, half = scene_of(ball("above"), ball("below")), 196
    state = state_of(scene, [(0, 0, 0.0145), (0, 0, -0.0145)])
    state.set_contacts([0, 0], [(0, 1), (0, 2)], distance=[-5e-4] * 2, force=[10, 10],
                       position=[(0, 0, 0.00475), (0, 0, -0.00475)], normal=[(0, 0, 1), (0, 0, -1)])  # fmt: skip
    read = reading(scene, state, KinematicTaxel(link="hand", probes=both_faces(), total="engine"))
    return f"{read[:half, 2].sum():.3f} and {read[half:, 2].sum():.3f} N"


def grazing() -> str:
    """Read four taxels at one end of a bar whose load of 10 N rests on the other end."""
    scene = scene_of(Geometry(name="bar", link="bar", kind="box", size=(0.019, 0.002, 0.002)))
    state = state_of(scene, [(0, 0, 0.007)])
    state.set_contacts([0], [(0, 1)], position=[(-0.015, 0, 0.005)], distance=[0.0], normal=[(0, 0, 1)], force=[10.0])
    grid = Probes.grid(2, 2, size=(0.004, 0.004), center=(0.015, 0, 0.005), radius=0.001)
    return f"{abs(reading(scene, state, KinematicTaxel(link='hand', probes=grid, total='engine'))[:, 2].sum()):.3f} N"


def plates() -> str:
    """Read taxels that a plate of .2 to 3 mm presses by .1 mm, from one side and the other."""
    import trimesh

    from brainbench.geometry import Mesh

    worst, signs = 0.0, 0
    for thickness in (2e-4, 5e-4, 1e-3, 3e-3):
        solid = trimesh.creation.box((0.1, 0.08, thickness))
        plate = Geometry(name="o", link="o", kind="mesh", mesh=Mesh(solid.vertices, solid.faces))
        for turn in ((1, 0, 0, 0), (0, 1, 0, 0)):
            scene = scene_of(plate)
            state = state_of(scene, [(0, 0, 0.005 - 1e-4 + thickness / 2)], turn=turn)
            state.set_contacts([0], [(0, 1)])
            read = reading(scene, state, KinematicTaxel(link="hand", probes=TOP))[:, 2]
            thick = -500 * 0.0021**1.2
            worst, signs = max(worst, float(np.abs(read / thick - 1).max())), signs + int((read > 0).sum())
    return f"{100 * worst:.1f} % off, {signs} of {8 * len(read)} signs wrong"


def heat() -> str:
    """Heat that a pad of default cells takes up in .01 s from steel, over that of two half-spaces."""
    from robotics_bridge.sensors.temperature.materials import ThermalBody, material

    half = (0.2, 0.2, 0.01)
    shapes = (Geometry(name="pad", link="pad", kind="box", size=half), ball("object", 0.04))
    grid = TemperatureGrid(link="pad", material="silicone", convection=0.0, radiates=False, base_temperature=33.0,
                           bodies={"object": ThermalBody("steel", 13.0)})  # fmt: skip
    suite, state = SensorSuite(TouchScene(("pad", "object"), shapes), {"t": grid}, num_envs=1), HandState.empty(1, 2, 4)
    corners = [[x, y, half[2]] for x in (-half[0], half[0]) for y in (-half[1], half[1])]
    state.set_contacts([0] * 4, [[0, 1]] * 4, position=corners, normal=[[0, 0, 1.0]] * 4)
    suite.update(state, 0.01)
    own, e2 = material("silicone"), material("steel").effusivity
    unit = own.density * own.specific_heat * np.prod(half) * 8
    taken = unit * (33 - suite.read_ground_truth("t").double().mean().item())
    e1 = own.effusivity
    return f"{taken / (40 * 0.16 * e1 * e2 / (e1 + e2) * np.sqrt(0.01 / np.pi)):.3f}"


def held() -> str:
    """Tangential over normal force of taxels over which a plate slid by 4 mm and now rests (μ = .8)."""
    scene = scene_of(Geometry(name="o", link="o", kind="box", size=(0.04, 0.04, 0.005)))
    suite = SensorSuite(scene, {"s": KinematicTaxel(link="hand", probes=TOP, friction=0.8)}, num_envs=1)
    for x in (0.0, 4e-3, 4e-3):
        state = state_of(scene, [(x, 0, 0.0095)])
        state.set_contacts([0], [(0, 1)])
        suite.update(state, 0.01)
    force = suite.read("s")[0].numpy().reshape(-1, 6).sum(0)
    return f"{abs(force[0] / force[2]):.2f} of the normal force"


def law_at_rest() -> str:
    """The same for taxels without the option."""
    try:
        return held()
    except TypeError:
        return "no option: 0"


def gripper() -> str:
    """Taxels of a gripper whose jaws slide."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gripper.xml"
        path.write_text(GRIPPER, "utf-8")
        layout = hands.load(path).layout("med", "hand")
    return f"{sum(len(p) for p in layout.values())} on {len(layout)} links"


def doubled_quaternion() -> str:
    """Distance to a box whose quaternion is (2, 0, 0, 2) rather than (1, 0, 0, 1)/√2; exact 10 mm."""
    scene = scene_of(Geometry(name="o", link="o", kind="box", size=(0.02, 0.005, 0.005)))
    state = state_of(scene, [(0, 0, 0.02)], turn=(2, 0, 0, 2))
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.001)
    return f"{1e3 * reading(scene, state, SurfaceDistanceProbe(link='hand', probes=probe))[0, 0]:.3g} mm"


def kept_contacts() -> str:
    """Force that a contact has after it was set anew without one."""
    state = state_of(scene_of(ball()), [(0, 0, 0.02)])
    state.set_contacts([0], [(0, 1)], force=[3.0])
    state.set_contacts([0], [(0, 1)])
    return f"{state.contact_force.numpy()[0]} N"


def click() -> str:
    """Loudest sample after a reset while 30 N are held."""
    scene = scene_of(ball())
    state = state_of(scene, [(0, 0, 0.0145)])
    state.set_contacts([0], [(0, 1)], distance=[-5e-4], force=[30.0], normal=[(0, 0, 1)])
    sound = ContactAudio(link="hand", modes=Modes((500.0,), (5.0,), (1.0,)), samples=100)
    suite = SensorSuite(scene, {"s": sound}, num_envs=1)
    for _ in range(3):
        suite.update(state, 0.01)
    suite.reset()
    suite.update(state, 0.01)
    return f"{float(suite.read('s').abs().max()):.2g}"


def uncolliding() -> str:
    """Depth with ``pairs="all"`` on a link without collision bits; .5 mm overlap and 2 mm radius."""
    import mujoco

    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body name="hand"><geom type="box"
      size=".02 .02 .005" contype="0" conaffinity="0"/></body><body name="ball" pos="0 0 .0145"><freejoint/>
      <geom type="sphere" size=".01"/></body></worldbody></mujoco>""")
    scene = TouchScene.from_mujoco(model)
    state = state_of(scene, [(0, 0, 0.0145)])
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.002)
    sensor = ContactDepthProbe(link="hand", probes=probe, pairs="all")
    return f"{1e3 * reading(scene, state, sensor)[0, 0]:.3g} mm"


def crowd() -> str:
    """What is said where twenty balls touch a link that lists sixteen."""
    scene = scene_of(*(ball(f"b{n}", 0.002) for n in range(20)))
    state = state_of(scene, [(0.0015 * n - 0.015, 0, 0.0068) for n in range(20)], contacts=20)
    state.set_contacts([0] * 20, [(0, n + 1) for n in range(20)])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        read = reading(scene, state, ContactDepthProbe(link="hand", probes=TOP))
    alone = reading(scene, state, ContactDepthProbe(link="hand", probes=TOP, pairs="all"))
    lost = int((np.abs(read - alone) > 1e-7).sum())
    return f"{lost} taxels wrong, {'said' if said else 'nothing said'}"


def lag() -> str:
    """Age of a reading with a delay of 30 ms at steps of 7 ms: least multiple that is not younger is 35 ms."""
    from robotics_bridge.sensors.noise.stages import simulate

    ramp = (np.arange(60) * 0.007).reshape(-1, 1, 1, 1)
    late = simulate(Noise(read_delay=0.03), ramp, dt=0.007)
    return f"{1e3 * float(ramp[-1].item() - late[-1].item()):.0f} ms"


def recovered() -> str:
    """What an environment reads at the first finite pose after a pose of NaN."""
    scene = scene_of(ball())
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.001)
    suite = SensorSuite(scene, {"s": SurfaceDistanceProbe(link="hand", probes=probe)}, num_envs=1)
    good, state = state_of(scene, [(0, 0, 0.02)]), state_of(scene, [(0, 0, float("nan"))])
    suite.update(state, 0.01)
    state.pose_torch.copy_(good.pose_torch)
    suite.update(state, 0.01)
    return f"{float(suite.read('s').item()):.3g} m"


def twist() -> str:
    """Default torsional friction of taxels of 4 mm."""
    return f"{KinematicTaxel(link='hand', probes=Probes.grid(2, 2, size=(0.01, 0.01), radius=0.004)).torsion:.2g} N m s"


FAULTS: dict[str, tuple[str, Callable[[], str]]] = {
    "1. link pinched by 10 N from both sides, `total=\"engine\"`": ("-10 and 10 N", pinched),
    "1. four taxels 30 mm beside a contact of 10 N": ("0 N", grazing),
    "2. plates of .2 to 3 mm, from both sides, beside a thick one": ("≤ 2 %, 0", plates),
    "3. heat taken up in .01 s by silicone on steel, of exact": ("1 ± .03", heat),
    "4. tangential force on what slid and now rests (μ = .8)": ("0.80", law_at_rest),
    "5. torsional friction of taxels of 4 mm, by default": ("1.6e-05 N m s", twist),
    "6. taxels of a gripper whose jaws slide": ("on every surface", gripper),
    "6. `pairs=\"all\"` without collision bits": ("2.5 mm", uncolliding),
    "6. twenty balls touch one link": ("0 wrong, or said", crowd),
    "7. quaternion (2, 0, 0, 2)": ("10 mm", doubled_quaternion),
    "7. force of a contact that was set anew without": ("nan N", kept_contacts),
    "7. sound at a reset while 30 N are held": ("0", click),
    "7. delay of 30 ms at steps of 7 ms": ("35 ms", lag),
    "a lost environment at its next finite pose": ("nan m until its reset", recovered),
}  # fmt: skip


def measured() -> list[str]:
    """Measure every fault with the tree that is imported; what it refuses is told by the kind of error."""
    found = []
    for _expected, work in FAULTS.values():
        try:
            found.append(work())
        except Exception as error:  # noqa: BLE001 - an earlier tree may fail in any way
            found.append(f"{type(error).__name__}: {str(error).splitlines()[0][:80]}")
    return found


def identities(scenes: int = 200) -> list[list[str]]:
    """Sums of taxels over contact forces in random scenes of one to six balls."""
    from scipy.spatial.transform import Rotation

    rng, worst = np.random.default_rng(0), {"law": np.zeros(2), "springs": np.zeros(2)}
    done = 0
    while done < scenes:
        count = int(rng.integers(1, 7))
        radii, side = rng.uniform(0.004, 0.012, count), rng.choice([-1.0, 1.0], count)
        overlap = rng.uniform(2e-4, 1e-3, count)
        at = np.c_[rng.uniform(-0.015, 0.015, (count, 2)), side * (0.005 + radii - overlap)]
        apart = np.linalg.norm(at[:, None] - at[None], axis=2) + 9 * np.eye(count)
        if (apart < radii[:, None] + radii[None]).any():
            continue  # Balls lie beside each other, not in each other.
        done += 1
        turn, origin = Rotation.random(rng=rng), rng.uniform(-0.1, 0.1, 3)
        scene = scene_of(*(ball(f"b{n}", r) for n, r in enumerate(radii)))
        state = HandState.empty(1, 2 + count, count)
        pose = np.zeros((2 + count, 7))
        pose[:, 3] = 1
        pose[1] = [*origin, *np.roll(turn.as_quat(), 1)]
        pose[2:, :3] = turn.apply(at) + origin
        state.set_pose(pose)
        load = rng.uniform(0.1, 10, count)
        push = -load[:, None] * np.c_[np.zeros((count, 2)), side]
        slip = -np.c_[rng.uniform(-0.5, 0.5, (count, 2)) * load[:, None], np.zeros(count)]
        where = np.c_[at[:, :2], side * (0.005 - overlap / 2)]
        state.set_contacts(np.zeros(count), [(0, n + 1) for n in range(count)], distance=-overlap, force=load,
                           position=turn.apply(where) + origin, normal=turn.apply(-push / load[:, None]),
                           friction=turn.apply(-slip))  # fmt: skip
        for name, knobs in (("law", {}), ("springs", {"friction": 0.8})):
            read = reading(scene, state, KinematicTaxel(link="hand", probes=both_faces(), total="engine", **knobs), 2)
            off = read[:, :3].sum(0) - (push + slip).sum(0)
            size = np.abs(load).sum()
            worst[name] = np.maximum(worst[name], [abs(off[2]) / size, np.linalg.norm(off[:2]) / size])
    said = f"{scenes} random scenes of 1 to 6 contacts"
    return [
        [f"Σ taxels = Σ contact forces, {part}, {name}", said, "1 %", f"{100 * value:.4f} %"]
        for name, values in worst.items()
        for part, value in zip(("normal", "tangential"), values, strict=True)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--measure", action="store_true", help="print this tree's numbers as JSON")
    parser.add_argument("--before", type=Path, help="folder of an earlier tree")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measured()))
        return
    from benchmarks.report import table, write_section

    after, before = measured(), ["–"] * len(FAULTS)
    if options.before:
        words = [sys.executable, str(Path(__file__).resolve()), "--measure"]
        surroundings = {**os.environ, "PYTHONPATH": str(options.before.resolve())}
        told = subprocess.check_output(words, env=surroundings, cwd=options.before, text=True)
        before = json.loads(told.splitlines()[-1])
    rows = [[name, right, b, a] for (name, (right, _)), b, a in zip(FAULTS.items(), before, after, strict=True)]
    body = f"Commit 583c5b5e and this one, by the same lines.\n\n{table(['fault', 'right', 'before', 'now'], rows)}"
    sums = table(["identity", "over", "allowed", "worst"], identities())
    print(f"{body}\n\n{sums}")
    if options.write:
        command = "python -m benchmarks.tactile.faults --before FOLDER --write"
        write_section("Touch: faults before and after", command, body, subject="tactile")
        write_section("Touch: what adds up", command, sums, subject="tactile")


if __name__ == "__main__":
    main()
