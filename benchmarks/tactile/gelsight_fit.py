"""Fit the elastomer to two real GelSight marker fields (FOTS, MIT licence): dilation, and shear on top of it.

The pad is an ElastomerTaxel with markers where the camera saw them; a ball of 3 mm presses and drags it. At most
eight numbers are fitted per field. The fields come as tracked by FOTS in whole pixels (``file``); the same pictures
are tracked here anew, below a pixel (``picture``). Printed: relative RMSE |model − real| / |real| in-sample, by
5-fold cross-validation over markers, and of the best possible model under rounding to pixels.

    python -m benchmarks.tactile.gelsight_fit --data ../shared/reference/gelsight/marker_calib/data [--write]
    [--picture FILE]
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from benchmarks.report import publish, script_parser, table
from robotics_bridge.physics import Geometry, HandState, TouchScene
from robotics_bridge.sensors import ElastomerTaxel, Probes, SensorSuite
from robotics_bridge.sensors.elastomer.taxel import Layer

MILLIMETRES_PER_PIXEL = 0.0532
SCALE = MILLIMETRES_PER_PIXEL * 1e-3
MIDDLE = (160.0, 120.0)
COLUMNS = 11
"""Markers of a row."""
BALL = 3e-3
CENTER = (np.array([136.4, 123.2]) - MIDDLE) * SCALE
"""Middle of the rings that the ball's print shows in picture 0 (m), read off by eye to a pixel; not fitted."""
PUBLISHED = {
    "dilate": {"FOTS": 0.514, "HydroShear": 0.403, "thesis": 0.329},
    "shear": {"FOTS": 0.210, "HydroShear": 0.217, "thesis": 0.174},
}
Model = Callable[[np.ndarray, np.ndarray], np.ndarray]


def load(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Markers [99, 2] about the image's centre, and the dilation and shear fields [99, 2] (m), of the files."""
    first, second = (np.loadtxt(folder / f"{n}.csv", delimiter=",", skiprows=1) for n in (0, 1))
    return (first[:, :2] - MIDDLE) * SCALE, first[:, 2:] * SCALE, (second[:, 2:] - first[:, 2:]) * SCALE


def load_tracked(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What :func:`load` gives, of markers wholly in view, tracked in the pictures themselves.

    There is no picture of the gel at rest: markers rest where a cubic lattice through the files' whole pixels puts
    them, which evens out the rounding.
    """
    from matplotlib.image import imread

    files = [np.loadtxt(folder / f"{n}.csv", delimiter=",", skiprows=1) for n in (0, 1)]
    rest = files[0][:, :2]
    row, column = (axis / 10 for axis in np.divmod(np.arange(len(rest)), COLUMNS))
    terms = np.stack([column**i * row**j for i in range(4) for j in range(4 - i)], axis=1)
    lattice = terms @ np.linalg.lstsq(terms, rest, rcond=None)[0]
    seen = [track(imread(folder / f"{n}.png"), rest + file[:, 2:]) for n, file in enumerate(files)]
    keep = rest[:, 0] < 310
    fields = (seen[0] - lattice, seen[1] - seen[0])
    return (lattice[keep] - MIDDLE) * SCALE, fields[0][keep] * SCALE, fields[1][keep] * SCALE


def track(picture: np.ndarray, guesses: np.ndarray, half: int = 9) -> np.ndarray:
    """Centres [N, 2] of the dark spots of a picture [H, W, 3], in pixels, near guesses [N, 2]."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    grey = np.asarray(picture, float)[..., :3].mean(axis=-1)
    dark = gaussian_filter(np.clip(gaussian_filter(grey, 25) - grey, 0, None), 0.7)
    found = []
    for guess in guesses:
        x, y = guess
        for _ in range(12):
            columns, rows = np.meshgrid(*(np.arange(-half, half + 1) + round(float(at)) for at in (x, y)))
            value = map_coordinates(dark, [rows, columns], order=1, mode="nearest")
            far = np.hypot(columns - x, rows - y)
            weight = np.clip(value - 0.35 * value[far < 6].max(), 0, None) * np.clip((half - far) / 2, 0, 1)
            before = x, y
            x, y = ((weight * axis).sum() / weight.sum() for axis in (columns, rows))
            if np.hypot(x - before[0], y - before[1]) < 1e-3:
                break
        found.append((x, y))
    return np.array(found)


class Pad:
    """One pressed and dragged pad; settings are the sensor's own fields."""

    def __init__(self, places: np.ndarray) -> None:
        ball = Geometry(name="ball", link="ball", kind="sphere", size=(BALL,))
        pad = Geometry(name="pad", link="pad", kind="box", size=(0.02, 0.02, 0.005), position=(0, 0, -0.005))
        self.scene = TouchScene(("world", "pad", "ball"), (pad, ball))
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
            pose = np.tile([0, 0, 0, 1.0, 0, 0, 0], (3, 1))
            pose[2, :3] = x, y, BALL - depth
            state.set_pose(pose)
            state.set_contacts([0], [(0, 1)])
            suite.update(state)
        return suite.read("pad")[0, : self.count, :2].numpy().astype(float)


def ball_heights(points: np.ndarray, center: np.ndarray, depth: float) -> np.ndarray:
    return np.maximum(BALL - np.linalg.norm(np.c_[points - center, np.full(len(points), BALL - depth)], axis=1), 0)


LATTICE = np.stack(np.meshgrid(*[np.linspace(-0.0095, 0.0095, 39)] * 2), -1).reshape(-1, 2)


def dilation(p: np.ndarray, x: np.ndarray) -> np.ndarray:
    """s_d, λ_d, recoil, depth, widening along and across, and drift of the whole gel (2)."""
    h = ball_heights(LATTICE, CENTER, abs(p[3]) * 1e-3)
    away = x[:, None] - LATTICE[None, h > 0]
    reach = np.exp(p[1]) * 1e6 * (away**2).sum(-1)
    w = p[0] * np.exp(-reach) * (1 - p[2] * reach) * h[h > 0]
    return (w[..., None] * away).sum(1) + p[4:6] * x + p[6:8] * 1e-3


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
    "dilate": [[60.0, s, k, d, 0.01, 0.01, 0.05, -0.04] for s in (-1.5, -0.5) for k in (0.0, 0.4) for d in (0.7, 1.2)],
    "shear": [[-0.7, 0.4, -0.1, 1.3, 0.3, 0.26, a, b] for a in (-0.02, 0.02) for b in (-1.0, 1.0)],
}
MODELS: dict[str, Model] = {"dilate": dilation, "shear": shear}


def floor(y: np.ndarray) -> float:
    """Relative RMSE of the true field when both places of a marker were rounded to pixels (variance 2 × 1/12)."""
    return float(np.sqrt(2 * len(y) / 6) * SCALE / np.linalg.norm(y))


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
    parser = script_parser(__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    fields, fitted, rows = {}, {}, []
    for source, (x, *both) in {"file": load(options.data), "picture": load_tracked(options.data)}.items():
        for name, y in zip(MODELS, both, strict=True):
            model = MODELS[name]
            p = fit(model, x, y, STARTS[name])
            fields[source, name], fitted[source, name] = (x, y, model(p, x)), p
            published = ", ".join(f"{who} {value}" for who, value in PUBLISHED[name].items())
            rounding = [f"{floor(y):.3f}" if source == "file" else "–"]
            cells = [f"{value:.3f}" for value in (relative(model(p, x), y), folds(model, x, y, p))] + rounding
            cells.append(f"{smooth_bound(x, y):.3f}")
            rows.append([name, source, str(len(x)), str(len(p)), *cells, published])
            print(*rows[-1], np.round(p, 3).tolist(), flush=True)
    x = fields["picture", "dilate"][0]
    print(f"sensor against closed form: {by_sensor(x, fitted['picture', 'dilate']):.1e}", flush=True)
    columns = ["field", "tracked in", "markers", "parameters", "in-sample", "5-fold", "rounding alone"]
    columns += ["best smooth field, leave-one-out", "published"]
    publish(options, "Elastomer on real GelSight fields", table(columns, rows), "--data FOLDER")
    if options.picture:
        draw(options.picture, {name: fields["picture", name] for name in MODELS}, rows[2:])


def by_sensor(x: np.ndarray, p: np.ndarray) -> float:
    """How far ElastomerTaxel with the fitted numbers lies from the fitted dilation, relative."""
    pad = Pad(x)
    depth = abs(p[3]) * 1e-3
    h = ball_heights(pad.probes.position[:, :2], CENTER, depth)
    strain = (float(p[4] / h.mean()), float(p[5] / h.mean()))
    spread = float(np.exp(p[1]) * 1e6)
    layer = Layer(recoil=float(p[2]), expansion=strain)
    read = pad.read([(*CENTER, depth)], dilate_scale=float(p[0]), dilate_spread=spread, points=0, layer=layer)
    # The lattice is the source; markers inside the contact are sources too and are taken out again.
    away = x[:, None] - x[None]
    reach = spread * (away**2).sum(-1)
    extra = (p[0] * (np.exp(-reach) * (1 - p[2] * reach) * h[None, : len(x)])[..., None] * away).sum(1)
    return relative(read - extra + p[6:8] * 1e-3, dilation(p, x))


def draw(path: Path, fields: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]], rows: list[list[str]]) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 4.0), dpi=110, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    for place, ((name, (x, real, model)), row) in enumerate(zip(fields.items(), rows, strict=True)):
        axes = figure.add_subplot(1, 2, place + 1)
        options = {"angles": "xy", "scale_units": "xy", "scale": 0.25, "width": 0.004}
        axes.quiver(*(x.T * 1e3), *(real.T * 1e3), color="0.55", label="GelSight", **options)
        axes.quiver(*(x.T * 1e3), *(model.T * 1e3), color="#c1440e", label="ElastomerTaxel", **options)
        axes.set_title(f"{name}: relative RMSE {row[4]}, 5-fold {row[5]} (arrows × 4)", fontsize=9)
        axes.set_aspect("equal")
        axes.set_xlim(-8.2, 8.8)
        axes.set_ylim(7.2, -7.2)
        axes.set_xlabel("x (mm)")
        axes.set_ylabel("y (mm)")
        axes.spines[["top", "right"]].set_visible(False)
        if place == 0:
            axes.legend(loc="lower left", fontsize=8, frameon=False, ncols=2)
    figure.savefig(path)


if __name__ == "__main__":
    main()
