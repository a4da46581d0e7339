"""Fit the elastomer to two real GelSight marker fields (FOTS, MIT licence): dilation, and shear on top of it.

The pad is an ElastomerTaxel with markers where the camera saw them; a ball of 3 mm presses and drags it. At most
eight numbers are fitted per field. Printed: relative RMSE |model − real| / |real| in-sample, by 5-fold
cross-validation over markers, and of the best possible model under rounding to pixels.

    python benchmarks/gelsight_fit.py --data ../shared/reference/gelsight/marker_calib/data [--write] [--picture FILE]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from benchmarks.results import table, write_section
from robotics_bridge.physics import Geometry, HandState, Scene
from robotics_bridge.sensors import ElastomerTaxel, Layer, Probes, SensorSuite

MILLIMETRES_PER_PIXEL = 0.0532
BALL = 3e-3
PUBLISHED = {
    "dilate": {"FOTS": 0.514, "HydroShear": 0.403, "thesis": 0.329},
    "shear": {"FOTS": 0.210, "HydroShear": 0.217, "thesis": 0.174},
}
Model = Callable[[np.ndarray, np.ndarray], np.ndarray]


def load(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Markers [99, 2] about the image's centre, and the dilation and shear fields [99, 2] (m)."""
    first, second = (np.loadtxt(folder / f"{n}.csv", delimiter=",", skiprows=1) for n in (0, 1))
    scale = MILLIMETRES_PER_PIXEL * 1e-3
    return (first[:, :2] - [160, 120]) * scale, first[:, 2:] * scale, (second[:, 2:] - first[:, 2:]) * scale


class Pad:
    """One pressed and dragged pad; settings are the sensor's own fields."""

    def __init__(self, places: np.ndarray) -> None:
        ball = Geometry(name="ball", link="ball", kind="sphere", size=(BALL,))
        pad = Geometry(name="pad", link="pad", kind="box", size=(0.02, 0.02, 0.005), position=(0, 0, -0.005))
        self.scene = Scene(("world", "pad", "ball"), (pad, ball))
        flat = np.concatenate([places, np.zeros((len(places), 1))], axis=1)
        # Sources on a fine lattice, since few of the camera's markers lie inside the contact.
        self.count = len(places)
        side = np.linspace(-0.0095, 0.0095, 39)
        lattice = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
        every = np.concatenate([flat, np.concatenate([lattice, np.zeros((len(lattice), 1))], 1)])
        self.probes = Probes(every, np.tile([0, 0, 1.0], (len(every), 1)), 1e-4)

    def read(self, way: list[tuple[float, float, float]], **settings: object) -> np.ndarray:
        """Displacements [99, 2] (m) after the ball's lowest point went along ``way`` (x, y, depth)."""
        sensor = ElastomerTaxel(link="pad", probes=self.probes, query="sdf", **settings)  # type: ignore[arg-type]
        suite = SensorSuite(self.scene, {"pad": sensor}, num_envs=1)
        state = HandState.empty(1, 3, 1)
        for x, y, depth in way:
            pose = np.tile([0, 0, 0, 0, 0, 0, 1.0], (3, 1))
            pose[2, :3] = x, y, BALL - depth
            state.set_pose(pose)
            state.set_contacts([0], [(0, 1)])
            suite.update(state)
        return suite.read("pad")[0, : self.count, :2].numpy().astype(float)


def ball_heights(points: np.ndarray, center: np.ndarray, depth: float) -> np.ndarray:
    return np.maximum(BALL - np.linalg.norm(np.c_[points - center, np.full(len(points), BALL - depth)], axis=1), 0)


LATTICE = np.stack(np.meshgrid(*[np.linspace(-0.0095, 0.0095, 39)] * 2), -1).reshape(-1, 2)
FRAME = (0.0125, 0.0095)


def dilation(p: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Centre (2), depth, s_d·depth scale, λ_d, widening of the clamped pad, and drift of the whole gel (2)."""
    center, depth = p[:2] * 1e-3, abs(p[2]) * 1e-3
    h = ball_heights(LATTICE, center, depth)
    away = x[:, None] - LATTICE[None, h > 0]
    w = p[3] * np.exp(-np.exp(p[4]) * 1e6 * (away**2).sum(-1)) * h[h > 0]
    widened = np.stack([f / np.pi * np.sin(np.pi * np.clip(x[:, a] / f, -1, 1)) for a, f in enumerate(FRAME)], 1)
    return (w[..., None] * away).sum(1) + p[5] * widened + p[6:8] * 1e-3


def shear(p: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Centre (2), drag (2), softening, Poisson ratio, and strength and reach of the dilation that dragging adds."""
    center, drag = p[:2] * 1e-3, p[2:4] * 1e-3
    away = x - center
    square = (away**2).sum(1) * 1e6 + np.exp(2 * p[4])
    inverse = 1 / np.sqrt(square)
    along = (away @ drag) * 1e6
    u = inverse[:, None] * ((1 - p[5]) * drag + p[5] * (along * inverse**2)[:, None] * away)
    return u + p[6] * away * np.exp(-np.exp(p[7]) * (away**2).sum(1) * 1e6)[:, None]


def fit(model: Model, x: np.ndarray, y: np.ndarray, starts: list[list[float]]) -> np.ndarray:
    runs = [least_squares(lambda p: (model(p, x) - y).ravel() * 1e3, start) for start in starts]
    return min(runs, key=lambda run: run.cost).x


def relative(model: np.ndarray, real: np.ndarray) -> float:
    return float(np.linalg.norm(model - real) / np.linalg.norm(real))


def folds(model: Model, x: np.ndarray, y: np.ndarray, start: np.ndarray, seed: int = 0) -> float:
    order = np.random.default_rng(seed).permutation(len(x))
    out = np.zeros_like(y)
    for k in range(5):
        test = order[k::5]
        train = np.setdiff1d(order, test)
        out[test] = model(fit(model, x[train], y[train], [list(start)]), x[test])
    return relative(out, y)


STARTS = {
    "dilate": [[-1.2, 0.1, d, 60.0, s, 0.01, 0.03, -0.06] for d in (0.5, 1.0) for s in (-2.0, -0.5, 0.5)],
    "shear": [[-0.7, 0.4, -0.1, 1.3, 0.3, 0.26, a, b] for a in (-0.02, 0.02) for b in (-1.0, 1.0)],
}
MODELS: dict[str, Model] = {"dilate": dilation, "shear": shear}


def floor(y: np.ndarray) -> float:
    """Relative RMSE of the true field when both places of a marker were rounded to pixels (variance 2 × 1/12)."""
    pixel = MILLIMETRES_PER_PIXEL * 1e-3
    return float(np.sqrt(2 * len(y) / 6) * pixel / np.linalg.norm(y))


def smooth_bound(x: np.ndarray, y: np.ndarray) -> float:
    """The least leave-one-out error of any smooth field: kriging over reaches and noise levels."""
    gaps = ((x[:, None] - x[None]) ** 2).sum(-1) * 1e6
    best = np.inf
    for reach in (1.0, 1.5, 2, 3, 4, 6):
        for noise in (0.003, 0.01, 0.03, 0.1, 0.3):
            kernel = np.exp(-gaps / (2 * reach**2)) + 1 + 0.01 * (x @ x.T) * 1e6
            hat = kernel @ np.linalg.inv(kernel + noise * np.eye(len(x)))
            left_out = (y - hat @ y) / (1 - np.diag(hat))[:, None]
            best = min(best, float(np.linalg.norm(left_out) / np.linalg.norm(y)))
    return best


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    x, dilate, sheared = load(options.data)
    fields, fitted, rows = {"dilate": dilate, "shear": sheared}, {}, []
    for name, y in fields.items():
        model = MODELS[name]
        p = fit(model, x, y, STARTS[name])
        fitted[name] = (p, model(p, x))
        missed = np.linalg.norm(fitted[name][1] - y, axis=1)
        worst = int(missed.argmax())
        keep = np.arange(len(x)) != worst
        published = ", ".join(f"{who} {value}" for who, value in PUBLISHED[name].items())
        cells = [relative(fitted[name][1], y), folds(model, x, y, p), floor(y), smooth_bound(x, y)]
        cells.append(relative(fitted[name][1][keep], y[keep]))
        rows.append([name, str(len(p)), *(f"{cell:.3f}" for cell in cells), published])
        print(name, *(f"{cell:.3f}" for cell in cells), published, np.round(p, 3).tolist(), flush=True)
    print("sensor against closed form:", *(f"{k} {v:.1e}" for k, v in by_sensor(x, fitted).items()), flush=True)
    columns = ["field", "parameters", "in-sample", "5-fold", "pixel floor", "best smooth field, leave-one-out"]
    columns += ["without its worst marker", "published"]
    if options.write:
        write_section("Elastomer on real GelSight fields", "python benchmarks/gelsight_fit.py", table(columns, rows))
    if options.picture:
        draw(options.picture, x, {name: (fields[name], fitted[name][1]) for name in fields}, rows)


def by_sensor(x: np.ndarray, fitted: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    """How far ElastomerTaxel with the fitted numbers lies from the fitted fields, relative."""
    p = fitted["dilate"][0]
    pad = Pad(x)
    h = ball_heights(pad.probes.position[:, :2], p[:2] * 1e-3, abs(p[2]) * 1e-3)
    layer = Layer(expansion=float(p[5] / h.mean()), frame=FRAME)
    settings = {"dilate_scale": float(p[3]), "dilate_spread": float(np.exp(p[4]) * 1e6), "points": 0, "layer": layer}
    # The lattice is the source; markers inside the contact are sources too and are taken out again.
    read = pad.read([(*(p[:2] * 1e-3), abs(p[2]) * 1e-3)], **settings)
    own = h[: len(x)]
    away = x[:, None] - x[None]
    extra = p[3] * (away * (np.exp(-np.exp(p[4]) * 1e6 * (away**2).sum(-1)) * own[None])[..., None]).sum(1)
    return {"dilate": relative(read - extra + p[6:8] * 1e-3, fitted["dilate"][1])}


def draw(path: Path, x: np.ndarray, fields: dict[str, tuple[np.ndarray, np.ndarray]], rows: list[list[str]]) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 3.9), dpi=110, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    for place, (name, (real, model)) in enumerate(fields.items()):
        axes = figure.add_subplot(1, 2, place + 1)
        options = {"angles": "xy", "scale_units": "xy", "scale": 0.25, "width": 0.004}
        axes.quiver(*(x.T * 1e3), *(real.T * 1e3), color="0.55", label="GelSight", **options)
        axes.quiver(*(x.T * 1e3), *(model.T * 1e3), color="#c1440e", label="ElastomerTaxel", **options)
        row = rows[place]
        axes.set_title(f"{name}: relative RMSE {row[2]} (5-fold {row[3]}, pixel floor {row[4]})", fontsize=9)
        axes.set_aspect("equal")
        axes.invert_yaxis()
        axes.set_xlabel("x (mm)")
        axes.set_ylabel("y (mm)")
        axes.spines[["top", "right"]].set_visible(False)
        if place == 0:
            axes.legend(loc="lower left", fontsize=8, frameon=False)
    figure.savefig(path)


if __name__ == "__main__":
    main()
