"""The grip, the objects and the pictures of ``brainbench tactile demo`` and ``policy play``.

Pictures need no display and no OpenGL.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import spectrogram

from brainbench.core.devices import mujoco_module as mujoco
from brainbench.core.figures import COLORS, new_figure, panels, save_figure
from brainbench.core.rotations import to_matrices
from brainbench.stimuli.figures import surfaces
from brainbench.stimuli.figures.pictures import Style, write_film
from robotics_bridge import hands
from robotics_bridge.hands.scenes import closing, holding
from robotics_bridge.physics import Geometry, HandState, MujocoEngine, TouchScene
from robotics_bridge.sensors import (
    ContactAudio,
    ElastomerTaxel,
    KinematicTaxel,
    Noise,
    Probes,
    SensorSuite,
    TemperatureGrid,
)
from robotics_bridge.sensors.audio.modes import find_modes
from robotics_bridge.sensors.queries.solids import tessellate
from robotics_bridge.sensors.temperature.materials import ThermalBody

if TYPE_CHECKING:
    from robotics_bridge.envs import Env

SIZE = (1100, 900)
SKIN, OBJECT = (0.80, 0.82, 0.86), (0.95, 0.75, 0.45)
SAMPLES = 2  # samples of a pixel along each axis


def link_rotation(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix of a link's pose [7], a transform (x, y, z, qx, qy, qz, qw)."""
    return to_matrices(np.roll(pose[3:], 1))


def surface(geometry: Any, color: tuple[float, float, float]) -> surfaces.Triangles:
    """Return the triangles of a geometry in the frame of its link; a plane has none."""
    if geometry.kind == "plane":
        return surfaces.Triangles.joined([])
    mesh, rotation = tessellate(geometry), to_matrices(geometry.quaternion)
    corners = mesh.vertices[mesh.faces] @ rotation.T + np.array(geometry.position)
    return surfaces.Triangles(
        corners, surfaces.corner_normals(mesh) @ rotation.T, np.broadcast_to(np.array(color), (len(corners), 3))
    )


def placed(solid: surfaces.Triangles, pose: NDArray[np.float64]) -> surfaces.Triangles:
    """Return triangles of a link in the world."""
    turn = link_rotation(pose)
    return replace(solid, corners=solid.corners @ turn.T + pose[:3], normals=solid.normals @ turn.T)


def shaded(solids: surfaces.Triangles, lens: surfaces.Lens, gloss: float) -> tuple[NDArray[np.float64], Any, Any]:
    """Draw triangles on white through a supersampled lens; return picture [H, W, 3], layer and light."""
    light = surfaces.lamp(lens, SAMPLES, solids.corners.reshape(-1, 3), solids)
    image = np.ones((lens.size[1], lens.size[0], 3))
    layer = surfaces.draw(solids, lens)
    surfaces.paint(layer, surfaces.shade(layer, lens, light, gloss=gloss, bias=8.0), image)
    return image, layer, light


def averaged(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a supersampled picture [H, W, 3] at its own size, from 0 to 1."""
    height, width = (size // SAMPLES for size in image.shape[:2])
    return np.clip(image.reshape(height, SAMPLES, width, SAMPLES, 3).mean(axis=(1, 3)), 0, 1)


def draw_forces(
    path: Path,
    scene: Any,
    pose: NDArray[np.float64],
    probes: Mapping[str, Any],
    readings: Mapping[str, NDArray[np.float64]],
) -> None:
    """Draw a hand with its taxels coloured by force, and arrows along the force (link frame)."""
    figure = new_figure(*SIZE)
    from matplotlib import cm, colormaps
    from matplotlib.colors import ListedColormap, Normalize

    peak = max(float(np.linalg.norm(force, axis=1).max()) for force in readings.values()) or 1e-9
    hand, held, marks = [], [], []
    for geometry in scene.geometries:
        triangles, color = (held, OBJECT) if geometry.link == "object" else (hand, SKIN)
        triangles.append(placed(surface(geometry, color), pose[scene.link_index(geometry.link)]))
    palette = colormaps["inferno"]
    for link, link_probes in probes.items():
        where = pose[scene.link_index(link)]
        turn = link_rotation(where)
        world, normal = link_probes.position @ turn.T + where[:3], link_probes.normal @ turn.T
        force = readings[link] @ turn.T
        for index in np.flatnonzero(link_probes.active):
            share = float(np.linalg.norm(force[index])) / peak
            color = np.array(palette(0.15 + 0.75 * share)[:3]) if share > 1e-3 else np.array([0.30, 0.42, 0.62])
            marks.append(surfaces.ball(world[index], 0.0007 + 0.0004 * (share > 1e-3), color))
            if share > 0.02:
                # The arrow shows the push on the skin from outside, so that it stays visible.
                tip = world[index] - force[index] / peak * 0.022
                start = world[index] + 0.0006 * normal[index]
                line = np.linspace(tip, start, 12)
                radii = np.r_[np.full(7, 0.00045), np.linspace(0.0011, 0.00015, 5)]
                marks.append(surfaces.tube(line, radii, np.broadcast_to(color, line.shape)))
    solid, taxels, seen = (
        surfaces.Triangles.joined(hand),
        surfaces.Triangles.joined(marks),
        surfaces.Triangles.joined(held),
    )
    camera = surfaces.Camera(view=(0.95, -0.55, 0.75))
    lens = camera.lens(np.concatenate([solid.corners.reshape(-1, 3), seen.corners.reshape(-1, 3)]), SIZE)
    fine = lens.supersampled(SAMPLES)
    image, layer, light = shaded(surfaces.Triangles.joined([solid, taxels]), fine, 0.08)
    veil = surfaces.draw(seen, fine)
    front = veil.nearness.reshape(-1)[veil.pixels] > layer.nearness.reshape(-1)[veil.pixels]
    colors = surfaces.shade(veil, fine, light)
    flat = image.reshape(-1, 3)
    flat[veil.pixels[front]] = 0.24 * colors[front] + 0.76 * flat[veil.pixels[front]]
    image = _trimmed(averaged(image))
    inches = image.shape[1] / 110, image.shape[0] / 110 + 0.75
    figure.set_size_inches(inches)
    axes = figure.add_axes((0, 0.75 / inches[1], 1, 1 - 0.75 / inches[1]))
    axes.imshow(image)
    axes.set_axis_off()
    part = ListedColormap(palette(np.linspace(0.15, 0.9, 256)))
    scale = cm.ScalarMappable(Normalize(0, peak), part)
    below = figure.add_axes((0.3, 0.55 / inches[1], 0.4, 0.14 / inches[1]))
    bar = figure.colorbar(scale, cax=below, orientation="horizontal")
    bar.set_label("force on a taxel (N); arrows push on the skin; blue taxels feel nothing", labelpad=2)
    save_figure(figure, path, dpi=110)


def _trimmed(image: NDArray[np.float64], margin: int = 24) -> NDArray[np.float64]:
    """Cut white borders off a picture [H, W, 3]."""
    darkest = image.min(axis=2)
    spans = []
    for used in (darkest.min(axis=1) < 0.999, darkest.min(axis=0) < 0.999):
        vertices = np.flatnonzero(used)
        low, high = (int(vertices[0]), int(vertices[-1]) + 1) if len(vertices) else (0, used.size)
        spans.append(slice(max(low - margin, 0), high + margin))
    return image[spans[0], spans[1]]


def draw_markers(path: Path, rest: NDArray[np.float64], fields: Mapping[str, NDArray[np.float64]]) -> None:
    """Draw marker displacements [N, 3] (m) from their places at rest [N, 3], one panel per motion."""
    figure, (axes,) = panels(1, len(fields), (11, 4.1))
    bulge = max(float(np.abs(field[:, 2]).max()) for field in fields.values()) or 1.0
    places = None
    for panel, (name, field) in zip(axes, fields.items(), strict=True):
        x, y = 1e3 * rest[:, 0], 1e3 * rest[:, 1]
        places = panel.scatter(x, y, c=field[:, 2] / bulge, s=16, cmap="viridis", vmin=0, vmax=1)
        largest = float(np.linalg.norm(field[:, :2], axis=1).max())
        stretch = 1.8e-3 / max(largest, 1e-12)
        panel.quiver(
            x, y, 1e3 * stretch * field[:, 0], 1e3 * stretch * field[:, 1], angles="xy", scale_units="xy", scale=1,
            width=0.004,
        )  # fmt: skip
        panel.set(title=f"{name}: up to {1e3 * largest:.2g} mm", xlabel="x (mm)", aspect="equal")
    axes[0].set_ylabel("y (mm)")
    figure.colorbar(places, ax=axes, label="displacement outwards (share of the largest)", shrink=0.8)
    save_figure(figure, path, dpi=110)


def draw_temperature(
    path: Path,
    link: str,
    times: NDArray[np.float64],
    lines: Mapping[str, NDArray[np.float64]],
    maps: Mapping[str, NDArray[np.float64]],
) -> None:
    """Draw the warmest cell over time, and for each material the warmest value along one axis (°C)."""
    figure, (axes,) = panels(1, 1 + len(maps), (12, 3.4), width_ratios=[1.5] + [1] * len(maps))
    from matplotlib.colors import PowerNorm

    colors = dict(zip(lines, COLORS, strict=False))
    for name, line in lines.items():
        axes[0].plot(times, line, color=colors.get(name), linewidth=1.8)
        place = {"xytext": (5, -3), "textcoords": "offset points", "color": colors.get(name), "fontsize": 9}
        axes[0].annotate(name, (times[-1], line[-1]), **place)
    axes[0].set(xlabel="time (s)", ylabel="warmest cell (°C)", title=f"tip {link.replace('right_hand_', '')}")
    axes[0].set_xlim(right=1.25 * times[-1])
    top = max(float(field.max()) for field in maps.values())
    bottom = min(float(field.min()) for field in maps.values())
    # The eye has to tell a tenth of a degree under wood from ten degrees under metal.
    scale = PowerNorm(0.35, bottom, top)
    image = None
    for panel, (name, field) in zip(axes[1:], maps.items(), strict=True):
        seen = field.max(axis=0).T
        image = panel.imshow(seen, origin="lower", cmap="inferno", norm=scale)
        panel.set_title(f"{name} ball, 45 °C: +{seen.max() - bottom:.1f} K", fontsize=10)
        panel.set(xlabel="cell across", xticks=[], yticks=[])
    axes[1].set_ylabel("cell along the finger")
    bar = figure.colorbar(image, ax=axes[1:], label="temperature (°C), colour: rise$^{0.35}$", shrink=0.85)
    bar.set_ticks([bottom, *(bottom + share * (top - bottom) for share in (0.02, 0.1, 0.3, 0.6)), top])
    bar.ax.yaxis.set_major_formatter("{x:.1f}")
    save_figure(figure, path, dpi=110)


def draw_sound(path: Path, signals: Mapping[str, NDArray[np.float64]], rate: float) -> None:
    """Draw spectrograms of signals [T] at a sample rate (Hz)."""
    figure, (axes,) = panels(1, len(signals), (12, 3.8), sharey=True)
    image = None
    for panel, (name, signal) in zip(axes, signals.items(), strict=True):
        frequency, time, power = spectrogram(signal, rate, nperseg=1024, noverlap=896)
        level = 10 * np.log10(power / power.max() + 1e-12)
        image = panel.pcolormesh(time, frequency / 1e3, level, vmin=-80, vmax=0, cmap="magma", rasterized=True)
        panel.set(title=f"ball on {name}", xlabel="time (s)")
    axes[0].set_ylabel("frequency (kHz)")
    figure.colorbar(image, ax=axes, label="level (dB below the loudest)", shrink=0.9)
    save_figure(figure, path, dpi=110)


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
    """Draws the first environment of a batch, of ``size`` (width, height) in pixels; the camera stands still."""

    def __init__(self, env: Env, size: tuple[int, int] = (480, 400)) -> None:
        self._env = env
        self._scene = env.simulation.engine.scene
        self._parts: list[tuple[int, Any]] = []
        focus = []
        for index in range(len(self._scene.geometries)):
            geometry = self._scene.geometry_in(0, index)
            link = self._scene.link_index(geometry.link)
            held = geometry.link in env.model.objects
            if (held and max(geometry.size) < 1e-3) or geometry.kind == "plane":
                continue
            solid = surface(geometry, WOOD if link == 0 else SKIN)
            if held:
                solid = replace(solid, colors=self._object_colors(geometry.link, solid))
            self._parts.append((link, solid))
            focus.append(placed(solid, self._pose()[link]).corners.reshape(-1, 3))
        points = np.concatenate(focus)
        self._lens = surfaces.Camera(view=VIEWS.get(env.task.name, _VIEW)).lens(points, size).supersampled(SAMPLES)

    def frame(self) -> NDArray[np.uint8]:
        """Return the picture [H, W, 3] of this moment."""
        pose = self._pose()
        solids = surfaces.Triangles.joined([placed(solid, pose[link]) for link, solid in self._parts])
        image, _, _ = shaded(solids, self._lens, 0.05)
        return (255 * averaged(image)).astype(np.uint8)

    def _pose(self) -> NDArray[np.float64]:
        return self._env.simulation.state.pose_torch[0].cpu().numpy().astype(float)

    def _object_colors(self, link: str, solid: Any) -> NDArray[np.float64]:
        if len(self._env.model.objects) > 1:
            hot = self._env.model.objects.index(link) == int(self._env.state.episode.target[0])
            return np.tile(np.array(HOT if hot else BALL), (len(solid.corners), 1))
        normal = np.cross(solid.corners[:, 1] - solid.corners[:, 0], solid.corners[:, 2] - solid.corners[:, 0])
        axis = np.abs(normal).argmax(axis=1)
        sign = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] < 0
        return FACES[2 * axis + sign]


def write_video(path: Path, frames: Sequence[NDArray[np.uint8]], size: tuple[int, int], rate: float) -> None:
    """Write frames to an ``.mp4`` or ``.gif``."""
    style, sample = Style(size=size, frames_per_second=rate), frames[:: max(1, len(frames) // 4)]
    write_film(path, frames, style, palette_from=sample)


class Grip:
    """A hand, palm up, that closes around a ball."""

    def __init__(self, hand: str) -> None:
        self.hand = hands.load(hand)
        self.model = holding(self.hand, radius=0.028, reach=0.9)
        self.engine = MujocoEngine(self.model, 1)
        self._closed = closing(self.hand, 0.72)
        # What slides has the ball between its jaws at once; fingers close by and by.
        moved = self.model.actuator_trnid[:, 0]
        self._slow = self.model.jnt_type[moved] != mujoco().mjtJoint.mjJNT_SLIDE
        self._steps = 0

    def run(self, steps: int) -> None:
        """Advance, closing the fingers over the first 200 steps."""
        for _ in range(steps):
            self._steps += 1
            if self.model.nu:
                self.engine.set(ctrl=self._closed * np.where(self._slow, min(self._steps / 200, 1.0), 1.0))
            self.engine.step()


def forces(path: Path, hand: str, resolution: str, *, noisy: bool) -> dict[str, float]:
    """Draw the forces on all taxels of a hand that holds a ball."""
    grip = Grip(hand)
    noise = Noise.preset("published-force") if noisy else Noise()
    members = {
        link: KinematicTaxel(link=link, probes=probes, track=("object",), noise=noise)
        for link, probes in grip.hand.layout(resolution, "hand").items()
    }
    suite = SensorSuite(grip.engine.scene, members, num_envs=1)
    for _ in range(300):
        grip.run(1)
        suite.update(grip.engine.state, grip.engine.timestep)
    readings = {link: suite.read(link)[0].reshape(-1, 6).numpy()[:, :3].copy() for link in members}
    pose = grip.engine.state.pose_torch[0].numpy().copy()
    probes = {link: sensor.probes for link, sensor in members.items()}
    draw_forces(path, grip.engine.scene, pose, probes, readings)
    true = [suite.read_ground_truth(link)[0].reshape(-1, 6)[:, :3].norm(dim=1) for link in members]
    touched = sum(int((force > 1e-3).sum()) for force in true)
    total = max(float(np.linalg.norm(force, axis=1).max()) for force in readings.values())
    taxels = sum(int(item.active.sum()) for item in probes.values())
    return {"taxels": taxels, "in contact": touched, "largest force (N)": total}


def markers(path: Path, *, noisy: bool) -> dict[str, float]:
    """Draw the markers of an elastomer pad that a ball presses, drags and twists."""
    probes = Probes.grid(15, 15, size=(0.018, 0.018), radius=0.001)
    shapes = (
        Geometry(name="pad", link="pad", kind="box", size=(0.012, 0.012, 0.002), position=(0, 0, -0.002)),
        Geometry(name="ball", link="ball", kind="sphere", size=(0.006,)),
    )
    noise = Noise.preset("published-elastomer") if noisy else Noise()
    # A soft thin gel: markers move by tenths of a millimetre, and shear stays near where it is applied.
    gel: dict[str, Any] = {"dilate_scale": 8.0, "dilate_spread": 1e5, "shear_scale": 8.0, "shear_spread": 1e5}
    sensor = ElastomerTaxel(link="pad", probes=probes, noise=noise, points=2000, **gel)
    suite = SensorSuite(TouchScene(("pad", "ball"), shapes), {"pad": sensor}, num_envs=1)
    state = HandState.empty(1, 2, 1)
    state.set_contacts([0], [[0, 1]])
    moves = {"pressed": (0.0, 0.0), "dragged": (0.0015, 0.0), "twisted": (0.0, 0.6)}
    fields = {}
    for name, (shift, twist) in moves.items():
        suite.reset()
        for share in np.linspace(0, 1, 21):
            pressed, moved = min(2 * share, 1.0), max(2 * share - 1, 0.0)
            pose = np.zeros((2, 7))
            pose[:, 3] = 1
            pose[1, :3] = moved * shift, 0, 0.006 - 0.0008 * pressed
            pose[1, [3, 6]] = np.cos(moved * twist / 2), np.sin(moved * twist / 2)
            state.set_pose(pose)
            suite.update(state, 0.01)
        fields[name] = suite.read("pad")[0].reshape(-1, 3).numpy().copy()
    draw_markers(path, probes.position, fields)
    return {f"{name} (mm)": 1e3 * float(np.linalg.norm(field[:, :2], axis=1).max()) for name, field in fields.items()}


def temperature(path: Path, hand: str) -> dict[str, float]:
    """Draw the warming of the finger tips by a ball of 45 °C, for three materials."""
    grip = Grip(hand)
    tips = grip.hand.tips
    members: dict[str, TemperatureGrid] = {}
    skin: dict[str, Any] = {"cells": (12, 12, 12), "material": "steel"}
    for name in ("aluminium", "glass", "wood"):
        bodies = {"object": ThermalBody(name, 45.0)}
        members |= {f"{name}/{link}": TemperatureGrid(link=link, bodies=bodies, **skin) for link in tips}
    suite = SensorSuite(grip.engine.scene, members, num_envs=1)
    times, traces = [], {name: [] for name in members}
    for step in range(1500):
        grip.run(1)
        suite.update(grip.engine.state, grip.engine.timestep)
        if step % 10 == 0:
            times.append(step * grip.engine.timestep)
            for name, trace in traces.items():
                trace.append(float(suite.read(name).max()))
    maps: dict[str, Any] = {name: suite.read(name)[0].numpy().copy() for name in members}
    warmest = max(tips, key=lambda link: maps[f"aluminium/{link}"].max())
    chosen = {name: maps[f"{name}/{warmest}"] for name in ("aluminium", "glass", "wood")}
    lines = {name: np.array(traces[f"{name}/{warmest}"]) for name in chosen}
    draw_temperature(path, warmest, np.array(times), lines, chosen)
    return {f"{name} (°C)": float(field.max()) for name, field in chosen.items()}


def sound(path: Path) -> dict[str, float]:
    """Draw spectrograms of a ball that bounces on plates of wood, metal and glass."""
    model = mujoco().MjModel.from_xml_string("""
    <mujoco><option timestep="0.005"/><worldbody>
      <body name="slab"><geom type="box" size="0.15 0.1 0.01" solref="0.004 0.3"/></body>
      <body name="ball" pos="0.03 0.02 0.12"><freejoint/>
        <geom size="0.02" mass="0.05" solref="0.004 0.3"/></body>
    </worldbody></mujoco>""")
    engine = MujocoEngine(model, 1, threads=1)
    solid = engine.scene.geometries[0]
    sensors = {
        name: ContactAudio(link="slab", samples=160, modes=find_modes(solid, name, count=24, cells=10))
        for name in ("wood", "metal", "glass")
    }
    suite = SensorSuite(engine.scene, sensors, num_envs=1)
    blocks: dict[str, list[Any]] = {name: [] for name in sensors}
    for _ in range(240):
        engine.step()
        suite.update(engine.state, engine.timestep)
        for name, heard in blocks.items():
            heard.append(suite.read(name)[0, 0].numpy().copy())
    signals = {name: np.concatenate(heard) for name, heard in blocks.items()}
    draw_sound(path, signals, 160 / engine.timestep)
    return {f"{name}: first mode (Hz)": sensor.modes.frequency[0] for name, sensor in sensors.items()}
