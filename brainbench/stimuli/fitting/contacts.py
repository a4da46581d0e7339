"""Contact point and contact force from traced shapes alone: the classical inverse problem, one frame at a time.

A whisker of known rest shape and stiffness is pressed by one frictionless point contact while its base is clamped; the
base's pose, the arc of the contact and the force are those whose quasi-static shape (:mod:`.elastica`) lies nearest to
the traced points (Solomon & Hartmann 2006, Nature 443, 525; Pammer et al. 2013, J. Neurosci. 33, 6726). Forces are
proportional to the bending stiffness that is assumed.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import DataError, UsageError, check_number
from brainbench.core.limits import Count, Limit, limited
from brainbench.stimuli.tracks.contract import check_length, check_track, traced_lengths
from brainbench.stimuli.validation.references import bent_by_contact, rest_curvature
from brainbench.stimuli.whiskers.whisker import Whisker

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
UNEVEN = 1e-3
"""Probability of a misfit as large, by chance, below which contacts of neighbouring frames change by no line."""
PER_LINK = 8  # samples of the curve in each link


def normal_offsets(nodes: Array, joints: Array, points: Array) -> Array:
    """Return the signed distances [n, k, d] (m) of a simulated curve from traced points, across the curve.

    Nodes lie on the whisker's curve, so a cubic spline through them is within its fourth order of it, where the chords
    of the links are off by their sagitta (10 µm for 1 mm links of a bent whisker, as much as the noise of tracks). From
    the nearest sample the foot of each point is found to second order, so that the distance is smooth in the shape.

    Args:
        nodes: arc lengths [N + 1] (m) of joints and tip.
        joints: their positions [n, N + 1, 3] (m).
        points: traced points [n, k, 2 or 3] (m); two axes are x and y of the same frame. NaN where missing.
    """
    from scipy.interpolate import CubicSpline

    # Frames behind the failure of a simulation are missing; a straight line stands for their curve.
    lost = ~np.asarray(np.isfinite(joints).all(axis=(1, 2)))[:, None, None]
    straight = np.outer(nodes, np.eye(points.shape[-1])[0])
    spline = CubicSpline(nodes, np.where(lost, straight, joints[..., : points.shape[-1]]), axis=1)
    s = np.linspace(nodes[0], nodes[-1], PER_LINK * (len(nodes) - 1) + 1)
    # Arc lengths of the nodes parametrise the curve nearly by arc: derivatives are normalised below all the same.
    place, along, bend = spline(s), spline(s, 1), spline(s, 2)
    return np.where(lost, np.nan, offsets_of_samples(place, along, bend, points))


def offsets_of_samples(place: Array, along: Array, bend: Array, points: Array) -> Array:
    """Return the signed distances [n, k, d] (m) of dense samples of a curve from points, across the curve.

    ``place``, ``along`` and ``bend`` [n, m, 2 or 3] are positions and their first and second derivatives by any
    parameter that runs along the curve; ``points`` are as for :func:`normal_offsets`.
    """
    # All points against all samples: some megabytes, and no search.
    between = points[:, :, None, :] - place[:, None]
    squares = np.nan_to_num(np.einsum("nkmi,nkmi->nkm", between, between), nan=np.inf)
    nearest = np.argmin(squares, axis=-1)[..., None]
    q, t, c = (np.take_along_axis(values, nearest, axis=1) for values in (place, along, bend))
    gap = points - q
    # Newton step on (p − r(s))·r′(s) = 0 with r ≈ q + t σ + c σ²/2.
    step = _dot(gap, t) / (_dot(t, t) - _dot(gap, c))
    foot, tangent = q + t * step + c * step**2 / 2, t + c * step
    tangent = tangent / np.sqrt(_dot(tangent, tangent))
    gap = foot - points
    if points.shape[-1] == 2:
        return (tangent[..., :1] * gap[..., 1:]) - (tangent[..., 1:] * gap[..., :1])
    first, second = _normals(tangent)
    return np.concatenate([_dot(gap, first), _dot(gap, second)], axis=-1)


def _dot(a: Array, b: Array) -> Array:
    return np.sum(a * b, axis=-1, keepdims=True)


def _normals(tangent: Array) -> tuple[Array, Array]:
    """Return two unit vectors [n, k, 3] across each tangent, the second nearest to the z axis."""
    axis = np.zeros_like(tangent)
    axis[..., 2] = 1.0
    # A tangent along z takes y instead.
    axis = np.where(np.abs(tangent[..., 2:]) > 0.9, np.roll(axis, -1, axis=-1), axis)
    second = axis - tangent * _dot(axis, tangent)
    second = second / np.sqrt(_dot(second, second))
    return np.cross(second, tangent), second


STEPS = 48  # runge-Kutta steps from the contact to the base; the force is then within 1e-6 of that of 400
BEYOND = 12  # samples from the contact to the tip


# From the contact to the base no angle and no position is needed: those of the base turn and move the finished shape,
# so no boundary-value problem is solved. Beyond the contact the rod has its rest curvature.
@dataclass(frozen=True, eq=False)
class LoadedShapes:
    """Shapes of a whisker under one contact each; sampled from the base to the tip."""

    place: Array
    """[b, m, 2] positions (m)."""
    angle: Array
    """[b, m] angle of the rod against x (rad)."""
    curvature: Array
    """[b, m] its derivative by arc (1/m)."""
    moment: Array
    """[b] moment of the whisker on its base about the base point (N·m)."""

    @property
    def contact(self) -> Array:
        """[b, 2] point of the centre line at the contact (m)."""
        return self.place[:, STEPS]

    @property
    def force(self) -> Array:
        """[b, 2] direction of a positive contact force: the normal on the left of the rod."""
        angle = self.angle[:, STEPS]
        return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)

    @property
    def along(self) -> Array:
        """[b, m, 2] unit tangents."""
        return np.stack([np.cos(self.angle), np.sin(self.angle)], axis=-1)


class LoadedWhisker:
    """A clamped whisker that one frictionless contact bends by any amount, in its plane."""

    def __init__(self, whisker: Whisker) -> None:
        self.whisker = whisker
        self._grid = np.linspace(0.0, whisker.arc_length, 1001)
        self._rest = rest_curvature(whisker, self._grid)
        self._turn = whisker.tangent_angle(self._grid)
        self._line = whisker.centre_line(self._grid)

    def rest_curvature(self, s: Array) -> Array:
        """Return the curvature κ₀ (1/m) of the rest shape at arcs s (m): of the parabola y = A x²."""
        return np.interp(s, self._grid, self._rest)

    def shapes(self, base: Array, arc: Array, force: Array) -> LoadedShapes:
        """Return the shapes under forces ``force`` [b] (N, positive to the left of the rod) at arcs ``arc`` [b] (m).

        ``base`` [b, 3] is the position (m) and the direction (rad) of the clamped base.
        """
        whisker = self.whisker
        half = arc[:, None] * np.linspace(1.0, 0.0, 2 * STEPS + 1)
        flexibility, rest = 1 / whisker.bending_stiffness(half), self.rest_curvature(half)
        steps = bent_by_contact(flexibility.T, rest.T, -arc / STEPS, force)
        psi, moment, x, y = (np.array(values) for values in zip(*steps, strict=True))
        bend = rest[:, ::2].T + moment * flexibility[:, ::2].T
        loaded = np.stack([x, y], axis=-1)[::-1].swapaxes(0, 1)
        free = arc[:, None] + (whisker.arc_length - arc)[:, None] * np.linspace(0, 1, BEYOND + 1)[1:]
        # The free end is the rest shape, turned so that it leaves the contact along ψ = 0.
        turn = np.interp(arc, self._grid, self._turn)
        end = self._rest_place(free) - self._rest_place(arc[:, None])
        place = np.concatenate([loaded, _rotated(end, -turn)], axis=1)
        angle = np.concatenate([psi[::-1].T, np.interp(free, self._grid, self._turn) - turn[:, None]], axis=1)
        curvature = np.concatenate([bend[::-1].T, self.rest_curvature(free)], axis=1)
        # Rigid motion that puts the base where it is.
        lift = base[:, 2] - angle[:, 0]
        place = _rotated(place - place[:, :1], lift) + base[:, None, :2]
        return LoadedShapes(place, angle + lift[:, None], curvature, moment[STEPS])

    def _rest_place(self, s: Array) -> Array:
        return np.stack([np.interp(s, self._grid, column) for column in self._line.T], axis=-1)


def _rotated(points: Array, angle: Array) -> Array:
    """Return points [b, m, 2] turned by angles [b] (rad)."""
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


_LOG = logging.getLogger(__name__)
NEAREST, FARTHEST = 0.05, 0.995  # contact arcs that are looked for, as shares of the whisker's length
NO_FORCE = 3.0  # force over its standard deviation below which there is no sign of a contact
VAGUE = 0.15  # relative standard deviation of the force from which it is unreliable
MISFIT = 1.5  # residuals over the stated noise from which the model does not fit
ALIKE = 4.0
"""Deviations of the serial correlation along the whisker, over all frames, from which residuals are no white noise."""
FEWEST_POINTS = 6
WHOLE = 0.95  # share of the whisker's length from which a trace counts as whole
SAMPLE, TURNED = 3, 0.5
"""Frames in which points are also fitted the other way round, and the share of their distance from the fitted shapes
below which that is the right way: it is a tenth where the order or the y axis is wrong, above one where it is right."""
_STEP = 1e-5
_ARCS = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9)
_DEFLECTIONS = (0.02, 0.06, 0.15, 0.3)
_UNITS = {"force": "N", "arc": "m", "moment": "N m", "base_angle": "rad", "force_deviation": "N", "arc_deviation": "m",
          "residual": "m", "force_vector": "N", "point": "m"}  # fmt: skip
"""Numbers that are found in a frame; the last two have two axes."""


@limited
class ContactOptions:
    """What is known of the traced shapes beside the whisker."""

    noise: Annotated[float, Limit(above=0, unit="m")] | None = None
    """Standard deviation of a traced coordinate [m]; estimated from each shape when None."""
    first_arc: float | Literal["base"] | None = "base"
    """Arc length of the first traced point [m]; None when the trace begins anywhere. Frames that lack it go without.
    ``base`` is 0 where nobody said so: then the trace must be about as long as the whisker."""
    tip_traced: bool = False
    """True when the last traced point is the tip of the whisker. Frames that lack it go without."""
    contact_noise: Annotated[float, Limit(above=0, unit="m")] = 5e-5
    """Standard deviation of the contact points that are given [m]."""
    frames: Count = 1
    """Neighbouring frames, an odd number, over which the contact's place and force are taken to change evenly."""

    def __post_init__(self) -> None:
        if self.frames % 2 == 0:
            raise UsageError(
                f"frames counts a frame and as many before as behind it, so it is odd; received {self.frames}."
            )


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """The fit of one frame."""

    unknowns: Array
    """[5] as of :class:`ContactSolver`."""
    covariance: Array
    """[5, 5] of them."""
    spread: float
    """Standard deviation of the traced points from the fitted shape [m]."""
    residual: float
    """Root mean square distance of them [m]."""
    reason: str = ""
    """Why there is no fit, if so."""
    alike: float = 0.0
    """Correlation of neighbouring residuals, over its standard deviation under white noise."""
    lacks: str = ""
    """What the frame lacks of what is known along the whisker, in a sentence."""


def find_contacts(
    shapes: xr.Dataset,
    whisker: Whisker,
    *,
    contact_points: ArrayLike | None = None,
    options: ContactOptions | None = None,
) -> xr.Dataset:
    """Estimate contact point and force in every frame of a track.

    Args:
        shapes: traced shapes in the plane of bending; three axes are projected on the plane that holds them best.
        whisker: its length, radii, curvature and Young's modulus; the others do not matter.
        contact_points: [n, 2] where the object touches the whisker (m), when it was tracked too; NaN where unknown.
        options: what else is known.

    Returns:
        ``force`` [time] (N, positive on the left of the whisker), ``force_vector`` [time, axis], ``arc``, ``point``
        [time, axis] (m), ``moment`` (N·m, of the whisker on its base), ``base_angle``, standard deviations
        ``force_deviation`` and ``arc_deviation``, ``residual`` (m), ``status`` and ``reason``. ``undefined``: no sign
        of a contact, or no fit.
    """
    import xarray as xr

    options = options or ContactOptions()
    if options.first_arc not in (None, "base"):
        check_number("first_arc (m) on this whisker", options.first_arc, least=0, most=whisker.arc_length)
    check_track(shapes)
    check_length(shapes, whisker.arc_length)
    points = _in_plane(shapes["shape"].values)
    places = np.full((len(points), 2), np.nan) if contact_points is None else np.asarray(contact_points, dtype=float)
    if places.shape != (len(points), 2):
        raise DataError(f"{len(points)} frames take contact points [{len(points)}, 2]; received {places.shape}.")
    solver, fits = ContactSolver(whisker, options), []
    before: Array | None = None
    for frame, place in zip(points, places, strict=True):
        fits.append(solver.solve(frame, place, before))
        before = fits[-1].unknowns if solver.estimate(fits[-1])["status"] == "ok" else None
    alike = np.array([one.alike for one in fits if not one.reason])
    if alike.sum() > ALIKE * math.sqrt(len(alike)):
        _LOG.warning(
            "Neighbouring points lie on the same side of the fitted shapes: the rest curvature, the taper or the arc "
            "of the first point is wrong, there are several contacts, or the tracker smooths its curves. Forces may "
            "then be wrong by much more than their standard deviations."
        )
    if options.frames > 1:
        fits = solver.even_out(fits, shapes["time"].values.astype(float))
    records = [solver.estimate(fit) for fit in fits]
    if fault := solver.track_fault(points, places, fits):
        for record in records:
            if np.isfinite(record["force"]):
                record["status"], record["reason"] = "unreliable", fault
    shape = {"force_vector": ("time", "axis"), "point": ("time", "axis")}
    return xr.Dataset(
        {
            **{
                name: (shape.get(name, "time"), [record[name] for record in records], {"units": unit})
                for name, unit in _UNITS.items()
            },
            **{
                name: ("time", np.array([record[name] for record in records], dtype=object))
                for name in ("status", "reason")
            },
        },
        coords={"time": shapes["time"], "axis": np.array(["x", "y"], dtype=object)},
        attrs={"young_modulus": whisker.young_modulus, "arc_length": whisker.arc_length},
    )


class ContactSolver:
    """Least squares on the quasi-static shape of one whisker.

    Unknowns, all near one: x and y of the base over the length L, its direction (rad), the contact's arc over L, and
    the deflection d over L that the force f would make in small bending, f = 3 E I(0) r(a)/r(0) d/a³.
    """

    def __init__(self, whisker: Whisker, options: ContactOptions) -> None:
        self.whisker, self.options, self.rod = whisker, options, LoadedWhisker(whisker)
        self.first_arc = 0.0 if options.first_arc == "base" else options.first_arc

    def force(self, arc: Array, deflection: Array) -> Array:
        """Return the force (N) of a small-bending deflection (m) at an arc (m)."""
        whisker = self.whisker
        # Small bending of a cone under a load f at a: d = f a³ r(0) / (3 E I(0) r(a)).
        stiffness = 3 * float(whisker.bending_stiffness(0.0)) * whisker.radius(arc) / whisker.base_radius
        return stiffness * deflection / arc**3

    def shapes(self, unknowns: Array) -> LoadedShapes:
        """Return the shapes of unknowns [b, 5]."""
        length = self.whisker.arc_length
        arc = unknowns[:, 3] * length
        base = unknowns[:, :3] * np.array([length, length, 1.0])
        return self.rod.shapes(base, arc, self.force(arc, unknowns[:, 4] * length))

    def residuals(self, unknowns: Array, frame: Array, place: Array, noise: float) -> Array:
        """Return residuals [b, m] over the noise: distances across the shape, and what is known along it."""
        points = frame[np.isfinite(frame).all(axis=-1)]
        shapes, options, length = self.shapes(unknowns), self.options, self.whisker.arc_length
        traced = np.broadcast_to(points, (len(unknowns), *points.shape))
        bend = shapes.curvature[..., None] * np.stack([-np.sin(shapes.angle), np.cos(shapes.angle)], axis=-1)
        rows = [offsets_of_samples(shapes.place, shapes.along, bend, traced)[..., 0] / noise]
        if self.first_arc is not None and np.isfinite(frame[0]).all():
            where = np.clip(self.first_arc / (unknowns[:, 3] * length), 0, 1) * STEPS
            low = np.minimum(where.astype(int), STEPS - 1)
            share, pick = (where - low)[:, None], np.arange(len(unknowns))
            start = (1 - share) * shapes.place[pick, low] + share * shapes.place[pick, low + 1]
            rows.append(np.sum((start - points[0]) * shapes.along[pick, low], axis=-1)[:, None] / noise)
        if options.tip_traced and np.isfinite(frame[-1]).all():
            gap = shapes.place[:, -1] - points[-1]
            rows.append(np.sum(gap * shapes.along[:, -1], axis=-1)[:, None] / noise)
        if np.isfinite(place).all():
            rows.append((shapes.contact - place) / options.contact_noise)
        return np.concatenate(rows, axis=1)

    def solve(self, frame: Array, place: Array, before: Array | None = None) -> ShapeFit:
        """Return the fit of one frame's points [k, 2] (m); ``before`` [5] are unknowns to start from as well."""
        from scipy.optimize import least_squares

        points = frame[np.isfinite(frame).all(axis=-1)]
        if len(points) < FEWEST_POINTS:
            missing = f"{len(points)} points were traced; {FEWEST_POINTS} are needed."
            return ShapeFit(np.full(5, np.nan), np.full((5, 5), np.nan), math.nan, math.nan, missing)
        noise = self.options.noise or 1e-3 * self.whisker.arc_length
        low = np.array([-np.inf, -np.inf, -np.inf, NEAREST, -3.0])
        high = np.array([np.inf, np.inf, np.inf, FARTHEST, 3.0])

        def _residual(unknowns: Array) -> Array:
            return self.residuals(unknowns[None], frame, place, noise)[0]

        def _jacobian(unknowns: Array) -> Array:
            moves = np.concatenate([np.eye(5), -np.eye(5)]) * _STEP
            values = self.residuals(unknowns + moves, frame, place, noise)
            return (values[:5] - values[5:]).T / (2 * _STEP)

        # The sum of squares has several minima, such as a near contact with a large force and a far one with a small.
        best = None
        for start in self._starts(frame, place, noise, before):
            began = np.clip(start, low + 1e-3, high - 1e-3)
            limits = (low, high)
            minimum = least_squares(_residual, began, jac=_jacobian, bounds=limits, max_nfev=60)  # type: ignore[arg-type]
            if best is None or minimum.cost < best.cost:
                best = minimum
        assert best is not None
        across = _residual(best.x)[: len(points)] * noise
        # Four unknowns follow distances across the shape; a shift along it changes none.
        spread = math.sqrt(float(np.sum(across**2)) / max(len(points) - 4, 1))
        matrix = _jacobian(best.x) * (1.0 if self.options.noise else noise / spread)
        covariance: Any = np.linalg.pinv(matrix.T @ matrix, rcond=1e-14)
        alike = math.sqrt(len(across)) * float(across[1:] @ across[:-1]) / max(float(across @ across), 1e-300)
        reason = "" if best.status > 0 else "The fit of the shape did not converge."
        in_use = (self.first_arc is not None, self.options.tip_traced)
        lost = [end for end, use, point in zip(("first", "last"), in_use, frame[[0, -1]], strict=True)
                if use and not np.isfinite(point).all()]  # fmt: skip
        lacks = f" The {' and the '.join(lost)} point was not traced in this frame." if lost else ""
        return ShapeFit(best.x, covariance, spread, math.sqrt(float(np.mean(across**2))), reason, alike, lacks)

    def _starts(self, frame: Array, place: Array, noise: float, before: Array | None) -> Sequence[Array]:
        """Return unknowns [5] to start from: the three best of a grid of arcs and forces, turned onto the points."""
        points = frame[np.isfinite(frame).all(axis=-1)]
        length = self.whisker.arc_length
        arcs, pushes = np.meshgrid(_ARCS, [0.0, *(s * d for d in _DEFLECTIONS for s in (1, -1))])
        chord = points[-1] - points[0]
        grid = np.zeros((arcs.size, 5))
        grid[:, :2], grid[:, 3], grid[:, 4] = points[0] / length, arcs.ravel(), pushes.ravel()
        trial = self.shapes(grid)
        # Each is turned about its base so that it points where the trace points.
        sample = trial.place[:, :: max(1, (STEPS + 1) // 8)] - trial.place[:, :1]
        size = np.linalg.norm(sample, axis=-1)
        reach = np.argmin(np.abs(size - np.linalg.norm(chord)), axis=1)
        tip = sample[np.arange(len(grid)), reach]
        grid[:, 2] = math.atan2(chord[1], chord[0]) - np.arctan2(tip[:, 1], tip[:, 0])
        cost = np.sum(self.residuals(grid, frame, place, noise) ** 2, axis=1)
        order = np.argsort(np.nan_to_num(cost, nan=np.inf))[:3]
        return [*grid[order], *([] if before is None else [before])]

    def track_fault(self, points: Array, places: Array, fits: Sequence[ShapeFit]) -> str:
        """Return in a sentence what is wrong with a track [n, k, 2] and its contact points [n, 2]; empty for nothing.

        Points that are listed or mirrored the other way fit a whisker of another taper or curvature at rest: turned
        back they lie much nearer to one.
        """
        fitted = [index for index, fit in enumerate(fits) if math.isfinite(fit.spread)]
        if not fitted:
            return ""
        sample = [fitted[k] for k in np.unique(np.linspace(0, len(fitted) - 1, SAMPLE).astype(int))]
        spread, mirror = float(np.median([fits[k].spread for k in sample])), np.array([1.0, -1.0])
        turned = {
            "listed from the tip to the base: give them from the base on": (points[:, ::-1], places),
            "mirrored: the y axis of the image runs the other way": (points * mirror, places * mirror),
        }
        spreads = {
            words: float(np.median([self.solve(track[k], contacts[k]).spread for k in sample]))
            for words, (track, contacts) in turned.items()
        }
        words = min(spreads, key=spreads.__getitem__)
        if spreads[words] < TURNED * spread:
            return (
                f"The points are {words}. As they are, they lie {1e6 * spread:.0f} µm from the shapes of this whisker, "
                f"else {1e6 * spreads[words]:.0f} µm."
            )
        length = float(np.nanmedian(traced_lengths(points)))
        if self.options.first_arc == "base" and length < WHOLE * self.whisker.arc_length:
            return (
                f"The trace is {1 - length / self.whisker.arc_length:.0%} shorter than the whisker; where it begins "
                "off the base forces come out much too large: give the arc length of its first point (first_arc), 0 "
                "for the base."
            )
        return ""

    def even_out(self, fits: Sequence[ShapeFit], times: Array) -> list[ShapeFit]:
        """Return fits whose contact changes evenly over neighbouring frames, at ``times`` [n] (s).

        The logarithms of arc and force of some frames are fitted by straight lines in time, weighted by their
        covariance; the pose of the base follows its regression on them. Frames with forces of the other sign, or with
        no sign of a force by themselves, have no part and stay as they are, as do frames that lie on no line.
        """
        from scipy.special import chdtrc

        some = {k: logarithms for k, one in enumerate(fits) if (logarithms := self._logarithms(one)) is not None}
        half, smoothed = self.options.frames // 2, list(fits)
        for index, (value, spread, slope) in some.items():
            near = range(index - half, index + half + 1)
            use = [k for k in near if k in some and fits[k].unknowns[4] * fits[index].unknowns[4] > 0]
            if len(use) < 3:
                continue
            design = [np.kron([1.0, times[k] - times[index]], np.eye(2)) for k in use]
            weights = [np.linalg.inv(some[k][1]) for k in use]
            information = sum(d.T @ w @ d for d, w in zip(design, weights, strict=True))
            weighted = sum(d.T @ w @ some[k][0] for d, w, k in zip(design, weights, use, strict=True))
            # Generalised least squares: each frame weighs by the inverse covariance of its own logarithms.
            line, covariance = np.linalg.solve(information, weighted), np.linalg.inv(information)[:2, :2]
            off = [some[k][0] - d @ line for k, d in zip(use, design, strict=True)]
            misfit = sum(float(part @ w @ part) for part, w in zip(off, weights, strict=True))
            if chdtrc(2 * len(use) - 4, misfit) < UNEVEN:
                continue
            # Unknowns given the logarithms: the Gaussian law of the frame's own fit, conditioned on them.
            gain = fits[index].covariance @ slope.T @ np.linalg.inv(spread)
            moved = fits[index].unknowns + gain @ (line[:2] - value)
            left = fits[index].covariance - gain @ (spread - covariance) @ gain.T
            moved[3] = np.clip(moved[3], NEAREST, FARTHEST)
            smoothed[index] = replace(fits[index], unknowns=moved, covariance=left)
        return smoothed

    def _logarithms(self, fit: ShapeFit) -> tuple[Array, Array, Array] | None:
        """Return log arc and log force [2], their covariance [2, 2], and their slope [2, 5] by the unknowns."""
        force, deviation, slope = self._force(fit)
        if fit.reason or not abs(force) >= NO_FORCE * deviation:
            return None
        by = np.stack([np.eye(5)[3] / fit.unknowns[3], slope / force])
        return np.log([fit.unknowns[3], abs(force)]), by @ fit.covariance @ by.T, by

    def _force(self, fit: ShapeFit) -> tuple[float, float, Array]:
        """Return the force (N) of a fit, its standard deviation, and its derivatives [5] by the unknowns."""
        length = self.whisker.arc_length
        ends = fit.unknowns + np.concatenate([np.zeros((1, 5)), np.eye(5), -np.eye(5)]) * _STEP
        sizes = self.force(ends[:, 3] * length, ends[:, 4] * length)
        slope = (sizes[1:6] - sizes[6:]) / (2 * _STEP)
        return float(sizes[0]), math.sqrt(max(float(slope @ fit.covariance @ slope), 0.0)), slope

    def estimate(self, fit: ShapeFit) -> dict[str, Any]:
        """Return what :func:`find_contacts` gives of a frame from its fit, with a status."""
        if not np.isfinite(fit.unknowns).all():
            nothing = dict.fromkeys(_UNITS, math.nan) | dict.fromkeys(("force_vector", "point"), (math.nan, math.nan))
            return {**nothing, "status": "undefined", "reason": fit.reason}
        length = self.whisker.arc_length
        force, deviation, _ = self._force(fit)
        shape = self.shapes(fit.unknowns[None])
        status, reason = self._judge(fit, force, deviation)
        reason += fit.lacks if reason else ""
        return {
            "force": force,
            "arc": length * float(fit.unknowns[3]),
            "moment": float(shape.moment[0]),
            "base_angle": float(fit.unknowns[2]),
            "force_deviation": deviation,
            "arc_deviation": length * math.sqrt(max(float(fit.covariance[3, 3]), 0.0)),
            "residual": fit.residual,
            "force_vector": (force * shape.force[0]).tolist(),
            "point": shape.contact[0].tolist(),
            "status": status,
            "reason": reason,
        }

    def _judge(self, fit: ShapeFit, force: float, deviation: float) -> tuple[str, str]:
        """Return the status of a fit and why, from its force and the standard deviation of it (N)."""
        noise = self.options.noise
        if fit.reason:
            return "undefined", fit.reason
        if abs(force) < NO_FORCE * deviation:
            share = abs(force) / max(deviation, 1e-300)
            return "undefined", f"No sign of a contact: the force is {share:.1f} standard deviations from 0."
        if noise and fit.spread > MISFIT * noise:
            return "unreliable", (
                f"The shape fits no whisker with one contact: points lie {1e6 * fit.spread:.0f} µm from it, the noise "
                f"is {1e6 * noise:.0f} µm."
            )
        if not NEAREST + 1e-3 < fit.unknowns[3] < FARTHEST - 1e-3:
            return "unreliable", "The contact lies at the end of the range that is looked for."
        if deviation > VAGUE * abs(force):
            return "unreliable", (
                f"The shape tells the force to {100 * deviation / abs(force):.0f} % only; give the contact point, "
                "trace more of the whisker, or let neighbouring frames share their contact (frames)."
            )
        return "ok", ""


def _in_plane(points: Array) -> Array:
    """Return points [n, k, 2] in the plane that holds them best; shapes in no plane are a :class:`DataError`."""
    if points.shape[-1] == 2:
        return points
    traced = points[np.isfinite(points).all(axis=-1)]
    _, spread, axes = np.linalg.svd(traced - traced.mean(axis=0), full_matrices=False)
    if spread[2] > 0.1 * spread[1] and spread[2] / math.sqrt(len(traced)) > 0.02 * np.ptp(traced @ axes[0]):
        raise DataError(
            "The traced shapes lie in no plane, and the contact force is found in the plane of bending alone; choose "
            "frames in which the whisker bends in one plane, or fit a scene with the object in it."
        )
    # Axes of the plane nearest to x and y, so that left stays left.
    normal = axes[2] * (1 if axes[2][2] >= 0 else -1)
    first = np.array([1.0, 0.0, 0.0]) - normal * normal[0]
    first = first / np.linalg.norm(first) if np.linalg.norm(first) > 1e-6 else axes[0]
    return points @ np.stack([first, np.cross(normal, first)], axis=-1)
