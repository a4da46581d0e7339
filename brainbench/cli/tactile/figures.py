"""The pictures of ``brainbench tactile demo``, without a display or OpenGL."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import spectrogram

from brainbench.core.figures.style import COLORS, new_figure, panels, save_figure
from brainbench.core.rotations import to_matrices
from brainbench.stimuli.figures.camera import Camera, Lens
from brainbench.stimuli.figures.surfaces import Triangles, ball, corner_normals, draw, lamp, paint, shade, tube
from robotics_bridge.sensors.queries.solids import tessellate

SIZE = (1100, 900)
SKIN, OBJECT = (0.80, 0.82, 0.86), (0.95, 0.75, 0.45)
SAMPLES = 2
"""Samples of a pixel along each axis."""


def link_rotation(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix of a link's pose [7], a transform (x, y, z, qx, qy, qz, qw)."""
    return to_matrices(np.roll(pose[3:], 1))


def surface(geometry: Any, color: tuple[float, float, float]) -> Triangles:
    """Return the triangles of a geometry in the frame of its link; a plane has none."""
    if geometry.kind == "plane":
        return Triangles.joined([])
    mesh, rotation = tessellate(geometry), to_matrices(geometry.quaternion)
    corners = mesh.vertices[mesh.faces] @ rotation.T + np.array(geometry.position)
    return Triangles(corners, corner_normals(mesh) @ rotation.T, np.broadcast_to(np.array(color), (len(corners), 3)))


def placed(solid: Triangles, pose: NDArray[np.float64]) -> Triangles:
    """Return triangles of a link in the world."""
    turn = link_rotation(pose)
    return replace(solid, corners=solid.corners @ turn.T + pose[:3], normals=solid.normals @ turn.T)


def shaded(solids: Triangles, lens: Lens, gloss: float) -> tuple[NDArray[np.float64], Any, Any]:
    """Draw triangles on white through a supersampled lens; return picture [H, W, 3], layer and light."""
    light = lamp(lens, SAMPLES, solids.corners.reshape(-1, 3), solids)
    image = np.ones((lens.size[1], lens.size[0], 3))
    layer = draw(solids, lens)
    paint(layer, shade(layer, lens, light, gloss=gloss, bias=8.0), image)
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
            marks.append(ball(world[index], 0.0007 + 0.0004 * (share > 1e-3), color))
            if share > 0.02:
                # The arrow shows the push on the skin from outside, so that it stays visible.
                tip = world[index] - force[index] / peak * 0.022
                start = world[index] + 0.0006 * normal[index]
                line = np.linspace(tip, start, 12)
                radii = np.r_[np.full(7, 0.00045), np.linspace(0.0011, 0.00015, 5)]
                marks.append(tube(line, radii, np.broadcast_to(color, line.shape)))
    solid, taxels, seen = Triangles.joined(hand), Triangles.joined(marks), Triangles.joined(held)
    camera = Camera(view=(0.95, -0.55, 0.75))
    lens = camera.lens(np.concatenate([solid.corners.reshape(-1, 3), seen.corners.reshape(-1, 3)]), SIZE)
    fine = lens.supersampled(SAMPLES)
    image, layer, light = shaded(Triangles.joined([solid, taxels]), fine, 0.08)
    veil = draw(seen, fine)
    front = veil.nearness.reshape(-1)[veil.pixels] > layer.nearness.reshape(-1)[veil.pixels]
    colors = shade(veil, fine, light)
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
