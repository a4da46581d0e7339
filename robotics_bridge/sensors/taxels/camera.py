"""Pictures of camera-based sensors such as GelSight and DIGIT: a gel's surface to colours, by a table of its slopes.

Coloured lamps around the gel give every slope of its surface a colour of its own. The table is read from one picture of
a ball that is pressed in, whose slopes are known: its own inside the contact, Sneddon's beside it. Colours are those of
the rested gel plus the table's (Yuan, Dong & Adelson 2017). Letters: B environment, H, W pixel, R, C marker.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from brainbench.core.errors import DataError, UsageError, check_number
from brainbench.core.files import atomic_path
from brainbench.core.reading.tensors import read_npz

SPAN = 1.5  # largest slope along an axis that the table holds
_BINS = 61
_BLUR = 1.0  # width (bins) over which neighbouring slopes share their colour, so that gaps of the table are filled
_MARKER = 0.12  # how much darker than its surroundings a marker is (of full scale)
_WIDEST = (25, 25)  # pixels in which a marker fits
_NODES = 32  # of the quadrature of slopes under a ball
_FITTED = 3  # order of the polynomial that stands for the picture of the rested gel, where there is none


@dataclass(frozen=True, eq=False)
class GelCamera:
    """Colours of one camera-based sensor."""

    background: NDArray[np.float64]
    """[H, W, 3] picture of the rested gel, from 0 to 1."""
    table: NDArray[np.float64]
    """[bins, bins, 3] change of colour by slope along y and x, each from −1.5 to 1.5."""
    pixel: float
    """Edge of a pixel on the gel (m)."""

    @classmethod
    def calibrate(
        cls,
        picture: ArrayLike,
        *,
        center: tuple[float, float],
        contact: float,
        ball: float,
        pixel: float,
        background: ArrayLike | None = None,
    ) -> GelCamera:
        """Read the table from a picture [H, W, 3] (bytes) of a ball that is pressed into the gel.

        Args:
            picture: with markers or without; markers are left out.
            center: of the contact (pixels: column, row).
            contact: radius of the contact (pixels).
            ball: radius of the ball (m).
            pixel: edge of a pixel on the gel (m).
            background: picture of the rested gel; without it a smooth one is fitted to what lies farther from the ball
                than twice the radius of the contact, which is less exact, as the gel slopes a little there too.
        """
        colours, clear = _colours(picture), ~_markers(_colours(picture))
        check_number("ball (m)", ball, above=0)
        check_number("pixel (m)", pixel, above=0)
        check_number("contact (pixels)", contact, above=1, below=ball / pixel)
        x, y, distance = _ball_slopes(colours.shape[:2], center, contact, ball / pixel)
        rest = _fitted(colours, clear & (distance > 2 * contact)) if background is None else _colours(background)
        if rest.shape != colours.shape:
            raise UsageError(f"The background has the shape {rest.shape}, the picture {colours.shape}.")
        near = clear & (distance <= 2 * contact)
        if not near.any():
            raise UsageError("No pixel of the picture shows the ball; is its centre (column, row) in pixels?")
        return cls(rest, _tabulate(_bins(np.stack([y, x]))[:, near], (colours - rest)[near]), pixel)

    def render(self, surface: ArrayLike, pitch: tuple[float, float] | None = None) -> NDArray[np.uint8]:
        """Return pictures [B, H, W, 3] of surfaces [B, R, C] (m, how far they are pushed in).

        ``pitch`` (m) is the distance of rows and of columns, which lie about the middle of the picture; None is a
        surface of one number a pixel. NaN gives black.
        """
        values = np.asarray(surface, dtype=float)
        height, width = self.background.shape[:2]
        if values.ndim != 3 or min(values.shape[1:]) < 2:
            raise UsageError(f"Surfaces are [B, rows, columns]; received the shape {values.shape}.")
        if pitch is None and values.shape[1:] != (height, width):
            raise UsageError(f"A surface without a pitch has {height} × {width} numbers; received {values.shape[1:]}.")
        pictures = np.zeros((len(values), height, width, 3), np.uint8)
        for picture, field in zip(pictures, values, strict=True):
            if not np.isfinite(field).all():
                continue
            pixels: Any = field
            if pitch is not None:
                rows, columns = (
                    (np.arange(count) - (count - 1) / 2) * self.pixel / step + (markers - 1) / 2
                    for count, step, markers in zip((height, width), pitch, field.shape, strict=True)
                )
                places = np.meshgrid(rows, columns, indexing="ij")
                pixels = ndimage.map_coordinates(field, places, order=3, mode="nearest")
            slopes: Any = np.gradient(pixels, self.pixel)
            at = _bins(np.stack(slopes))
            planes: list[Any] = [
                ndimage.map_coordinates(plane, at, order=1) for plane in np.moveaxis(self.table, -1, 0)
            ]
            change = np.stack(planes, axis=-1)
            picture[:] = np.round(255 * (self.background + change).clip(0, 1))
        return pictures

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the camera as ``.npz``."""
        with atomic_path(path) as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, background=self.background, table=self.table, pixel=self.pixel)
        return Path(path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> GelCamera:
        """Read what :meth:`save` wrote."""
        arrays = dict(read_npz(path, "gel camera"))
        try:
            background, table, pixel = (np.asarray(arrays[key], float) for key in ("background", "table", "pixel"))
        except (KeyError, ValueError):
            raise DataError(f"{path} is no gel camera: it holds {', '.join(sorted(arrays))}.") from None
        if background.ndim != 3 or background.shape[2] != 3 or table.shape != (_BINS, _BINS, 3) or pixel.ndim:
            raise DataError(f"{path} is no gel camera: its shapes are {background.shape} and {table.shape}.")
        return cls(background, table, float(pixel))


def _colours(picture: ArrayLike) -> NDArray[np.float64]:
    """Return a picture of bytes as numbers from 0 to 1."""
    values = np.asarray(picture)
    if values.ndim != 3 or values.shape[2] != 3 or values.dtype != np.uint8:
        raise UsageError(f"A picture is [height, width, 3] of bytes; received {values.shape} of {values.dtype}.")
    return values / 255.0


def _markers(colours: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask [H, W] of dark markers and their rims."""
    darkest = colours.min(axis=-1)
    around: Any = ndimage.grey_closing(darkest, _WIDEST)
    markers: Any = ndimage.binary_dilation(darkest < around - _MARKER, iterations=2)
    return markers


def _ball_slopes(
    shape: tuple[int, ...], center: tuple[float, float], contact: float, radius: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return slopes along x and y [H, W] of a gel under a ball, and distances from its centre, all in pixels."""
    y, x = np.mgrid[: shape[0], : shape[1]] - np.reshape(center[::-1], (2, 1, 1))
    distance = np.hypot(x, y)
    # The slope of a half-space under a rigid ball (Sneddon 1965): 2/π ∫ g(r sin φ) sin φ dφ up to asin(a/r), with
    # g(t) = atanh(t/R) + tR/(R² − t²). Inside the contact it is the ball's; Hertz's paraboloid is flatter.
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    end = np.arcsin(np.minimum(contact / np.maximum(distance, 1e-9), 1.0))[..., None]
    sines = np.sin(end * (nodes + 1) / 2)
    t = distance[..., None] * sines / radius
    slope = -((np.arctanh(t) + t / (1 - t**2)) * sines * end) @ weights / np.pi
    return slope * x / np.maximum(distance, 1e-9), slope * y / np.maximum(distance, 1e-9), distance


def _bins(slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where slopes [2, …] along y and x lie in the table."""
    return ((slopes / SPAN).clip(-1, 1) + 1) * (_BINS - 1) / 2


def _tabulate(at: NDArray[np.float64], change: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the table of changes of colour [M, 3] at places [2, M] of it."""
    total, count = np.zeros((_BINS, _BINS, 3)), np.zeros((_BINS, _BINS, 1))
    bins = tuple(np.round(at).astype(int))
    np.add.at(total, bins, change)
    np.add.at(count, bins, 1.0)
    blurred: list[Any] = [ndimage.gaussian_filter(values, (_BLUR, _BLUR, 0)) for values in (total, count)]
    total, count = blurred
    # Slopes that the ball does not show take the colour of the nearest that it does.
    unseen = count[..., 0] < 1e-3
    nearest: Any = ndimage.distance_transform_edt(unseen, return_distances=False, return_indices=True)
    return (total / np.maximum(count, 1e-12))[tuple(nearest)]


def _fitted(colours: NDArray[np.float64], clear: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the smooth picture [H, W, 3] that pixels of a mask are nearest to."""
    y, x = (np.linspace(-1, 1, count) for count in colours.shape[:2])
    terms = [np.outer(y**i, x**j) for i in range(_FITTED + 1) for j in range(_FITTED + 1 - i)]
    if clear.sum() < 10 * len(terms):
        raise UsageError("Too little of the picture is free of the ball to guess the rested gel; give background=.")
    basis = np.stack(terms, axis=-1)
    return (basis @ np.linalg.lstsq(basis[clear], colours[clear], rcond=None)[0]).clip(0, 1)
