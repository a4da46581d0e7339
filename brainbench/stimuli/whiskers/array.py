"""Whisker arrays of the mouse and the rat, from published measurements or from the equations fitted to them.

Array frame: origin at the mean of all base points of both sides, x to the animal's right, y rostral,
z dorsal; metres. The tables under ``data/`` hold the published numbers (mm, rad) with their sources.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Literal

from brainbench.core.errors import UsageError, brief, check_each, check_name, unknown_name
from brainbench.core.limits import limited
from brainbench.core.rotations import Angles, Point
from brainbench.stimuli.whiskers.whisker import Whisker

ROWS = "ABCDE"  # letters of the whisker rows, dorsal to ventral

_RANGE = re.compile(r"([A-Ea-e])(\d+)\s*-\s*([A-Ea-e])(\d+)")


def match_whiskers(pattern: str, names: Sequence[str], rows: Sequence[int], cols: Sequence[int]) -> list[int]:
    """Return the ascending indices of the whiskers that ``pattern`` names.

    Args:
        pattern: ``all``, or terms joined by commas: a name (``C2``), a row (``C*``), a column
            (``*2``), or a range within a row or a column (``C0-C3``, ``A1-E1``; gaps are skipped).
            Case does not matter. In an array with both sides ``C2`` names both and ``RC2`` one.
        names: unique names, ``C2`` or with a side ``RC2``.
        rows, cols: grid row (0 for A) and column of each whisker.
    """
    terms = [term.strip() for term in pattern.split(",") if term.strip()]
    if not terms:
        raise UsageError(f"The whisker selection {pattern!r} is empty; write 'all', 'C0-C3', 'C*' or 'C2,D1'.")
    short = [f"{ROWS[row]}{col}" for row, col in zip(rows, cols, strict=True)]
    cells = list(zip(rows, cols, strict=True))
    return sorted({index for term in terms for index in _match(term, list(names), short, cells)})


def _match(term: str, names: list[str], short: list[str], cells: list[tuple[int, int]]) -> list[int]:
    """Return the indices that one term names."""
    if term.lower() == "all":
        return list(range(len(names)))
    span = _RANGE.fullmatch(term)
    if span is None:
        shape = re.compile(".*".join(map(re.escape, term.split("*"))), re.IGNORECASE)
        matches = [i for i, name in enumerate(names) if shape.fullmatch(name) or shape.fullmatch(short[i])]
        if not matches:
            raise unknown_name("whisker", term, dict.fromkeys([*short, *names]))
        return matches
    row0, col0, row1, col1 = span.groups()
    for end in (row0 + col0, row1 + col1):
        _match(end, names, short, cells)
    first, last = (ROWS.index(row0.upper()), int(col0)), (ROWS.index(row1.upper()), int(col1))
    if (first[0] != last[0] and first[1] != last[1]) or first > last:
        raise UsageError(
            f"The whisker range {term!r} must ascend within one row (C0-C3) or one column (A1-E1);"
            " join several terms with commas."
        )
    return [i for i, (row, col) in enumerate(cells) if first[0] <= row <= last[0] and first[1] <= col <= last[1]]


Side = Literal["right", "left", "both"]
Source = Literal["average", "model"]
SPECIES = ("mouse", "rat")
SIDES = ("right", "left", "both")
SOURCES = ("average", "model")

_MM = 1e-3


@limited(of="{} of a whisker")
class MountedWhisker:
    """One whisker with its place on the face."""

    name: str
    """Row letter and column number, such as ``C2``."""
    side: Literal["right", "left"]
    row: int
    """0 for row A to 4 for row E."""
    col: int
    position: Point
    """Base point [m, array frame]."""
    angles: Angles
    """(θ, φ, ζ) at rest [rad]: Rz(θ − π/2) · Ry(−φ) · Rx(ζ + π/2) maps the base frame to the array frame."""
    whisker: Whisker

    @property
    def full_name(self) -> str:
        """Side and name, such as ``RC2``."""
        return self.side[0].upper() + self.name

    def mirrored(self) -> MountedWhisker:
        """Return the whisker of the other side: x, θ, ζ and torsion change sign, the curvature does not."""
        (x, y, z), (theta, phi, zeta) = self.position, self.angles
        # A mirrored base frame is left-handed. A whisker is symmetric about its x-y plane, so reversing z makes the
        # frame right-handed again: that is (−θ, φ, −ζ).
        side = "left" if self.side == "right" else "right"
        rod = dataclasses.replace(self.whisker, bends=tuple((s, bend, -turn) for s, bend, turn in self.whisker.bends))
        return dataclasses.replace(self, side=side, position=(-x, y, z), angles=(-theta, phi, -zeta), whisker=rod)


@dataclass(frozen=True)
class WhiskerArray:
    """An ordered set of mounted whiskers.

    >>> WhiskerArray.mouse(whiskers="C0-C3").names
    ('C0', 'C1', 'C2', 'C3')
    """

    species: str
    mounts: tuple[MountedWhisker, ...]
    citation: str = ""

    @classmethod
    def of(
        cls, species: str = "mouse", *, side: Side = "right", whiskers: str = "all", source: Source = "average"
    ) -> WhiskerArray:
        """Return the array of one of :data:`SPECIES`.

        Args:
            species: ``mouse`` or ``rat``.
            side: ``right`` (published), ``left`` (its exact mirror image) or ``both``.
            whiskers: a selection as :meth:`select` takes it.
            source: ``average``, the measured means; or ``model``, the equations fitted to them, which give
                arc length, curvature, base point and angles from row and column alone.
        """
        check_name("species", species, SPECIES)
        check_name("source of an array", source, SOURCES)
        if source == "model" and "model" not in _read(species):
            raise UsageError(
                f"There are no model equations of the {species} here: those of Bresee et al. (2023) are in no source "
                "that we could read, and the released mouse scripts hold the rat's; use source='average', or the rat's "
                "model."
            )
        return (_published if source == "average" else _modelled)(species).on_side(side).select(whiskers)

    @classmethod
    def mouse(cls, *, side: Side = "right", whiskers: str = "all", source: Source = "average") -> WhiskerArray:
        """Return the average mouse (Bresee et al. 2023): 30 whiskers a side, A0–A4, B0–B4, C0–C6, D0–D6, E0–E5.

        Arguments are those of :meth:`of`; there is no ``model`` of the mouse here.
        """
        return cls.of("mouse", side=side, whiskers=whiskers, source=source)

    @classmethod
    def rat(cls, *, side: Side = "right", whiskers: str = "all", source: Source = "average") -> WhiskerArray:
        """Return the rat (Belli et al. 2018): 30 whiskers a side, A0–A4, B0–B4, C0–C6, D0–D6, E1–E6; see :meth:`of`."""
        return cls.of("rat", side=side, whiskers=whiskers, source=source)

    def __iter__(self) -> Iterator[MountedWhisker]:
        return iter(self.mounts)

    def __len__(self) -> int:
        return len(self.mounts)

    def __getitem__(self, name: str) -> MountedWhisker:
        upper = [item.upper() for item in self.names]
        if name.upper() not in upper:
            raise unknown_name("whisker", name, self.names)
        return self.mounts[upper.index(name.upper())]

    @property
    def names(self) -> tuple[str, ...]:
        """Unique names in order: ``C2``, or ``RC2`` and ``LC2`` when the array has both sides."""
        both = len({mount.side for mount in self.mounts}) > 1
        return tuple(mount.full_name if both else mount.name for mount in self.mounts)

    @property
    def side(self) -> Side:
        """``right``, ``left`` or ``both``."""
        first = self.mounts[0].side
        return first if all(mount.side == first for mount in self.mounts) else "both"

    def on_side(self, side: Side) -> WhiskerArray:
        """Return the one-sided array on the right, on the left or, mirrored, on both sides (right first)."""
        check_name("side", side, SIDES)
        if side == self.side:
            return self
        if self.side == "both":
            mounts = tuple(mount for mount in self.mounts if mount.side == side)
        else:
            mirrored = tuple(mount.mirrored() for mount in self.mounts)
            pair = (self.mounts, mirrored) if self.side == "right" else (mirrored, self.mounts)
            mounts = {"right": pair[0], "left": pair[1], "both": pair[0] + pair[1]}[side]
        return dataclasses.replace(self, mounts=mounts)

    def select(self, pattern: str = "all") -> WhiskerArray:
        """Return the named whiskers, in the order of the array: ``all``, ``C2,D1``, ``C0-C3``, ``C*`` ….

        Names and errors are those of :func:`brainbench.stimuli.whiskers.array.match_whiskers`.
        """
        rows, cols = [mount.row for mount in self.mounts], [mount.col for mount in self.mounts]
        chosen = match_whiskers(pattern, self.names, rows, cols)
        return dataclasses.replace(self, mounts=tuple(self.mounts[index] for index in chosen))

    def replace(self, pattern: str = "all", **changes: Any) -> WhiskerArray:
        """Return a copy in which the whiskers that :meth:`select` names have other properties.

        ``changes`` are fields of :class:`Whisker` (SI units), or ``position`` and ``angles``; others are a
        :class:`UsageError`.
        """
        places = {"position", "angles"}
        allowed = places | {field.name for field in dataclasses.fields(Whisker)}
        check_each("whisker property", changes, sorted(allowed))
        mounted = {key: tuple(map(float, value)) for key, value in changes.items() if key in places}
        rod = {key: value for key, value in changes.items() if key not in places}
        chosen = set(self.select(pattern).mounts)
        if len({mount.side for mount in chosen}) > 1 and (mounted or any(turn for *_, turn in rod.get("bends", ()))):
            raise UsageError(
                f"Places, angles and torsion have other signs on the other side, and {brief(pattern)} names whiskers of"
                " both; name each side, as in RC2 and LC2."
            )
        mounts = tuple(
            dataclasses.replace(mount, whisker=dataclasses.replace(mount.whisker, **rod), **mounted)
            if mount in chosen
            else mount
            for mount in self.mounts
        )
        return dataclasses.replace(self, mounts=mounts)


def published_whisker(arc_length: float, curvature: float, row: int, col: int, *, species: str = "rat") -> Whisker:
    """Return a whisker with the published rules for its diameters and its material, those of one species.

    ``arc_length`` (mm) and ``curvature`` (A of y = A x², 1/mm, positive) are as in the published tables, ``row`` is 0
    for A.
    """
    table = _read(species)
    base, tip = _radii(arc_length, row, col, table["diameter"])
    material = {key: item["value"] for key, item in table["material"].items()}
    return Whisker(
        arc_length=arc_length * _MM,
        base_radius=base * _MM,
        tip_radius=tip * _MM,
        young_modulus=material["young_modulus_pa"],
        density=tuple(material["density_base_tip_kg_m3"]),
        damping_ratio=material["damping_ratio"],
        # The published bend angles are negative: the whisker curves towards local −y.
        curvature=-curvature / _MM,
        friction=material["friction"],
        poisson_ratio=material["poisson_ratio"],
    )


@cache
def _read(species: str) -> dict[str, Any]:
    text = resources.files("brainbench.stimuli").joinpath("data", f"{species}.json").read_text(encoding="utf-8")
    return json.loads(text)


@cache
def _published(species: str) -> WhiskerArray:
    """Build one species' table: the right side."""
    table, mounts = _read(species), []
    for values in table["whiskers"]:
        entry = dict(zip(table["columns"], values, strict=True))
        row, col = entry["row"], entry["column"]
        position = (entry["x_mm"] * _MM, entry["y_mm"] * _MM, entry["z_mm"] * _MM)
        angles = (entry["theta_rad"], entry["phi_rad"], entry["zeta_rad"])
        whisker = published_whisker(entry["arc_length_mm"], entry["curvature_per_mm"], row, col, species=species)
        mounts.append(MountedWhisker(entry["name"], "right", row, col, position, angles, whisker))
    return WhiskerArray(species=table["species"], mounts=tuple(mounts), citation=table["citation"])


@cache
def _modelled(species: str) -> WhiskerArray:
    """Build the whiskers of one species' table from its model equations: the right side."""
    model = _read(species)["model"]
    mounts = []
    for average in _published(species):
        values = {"row": float(average.row + 1), "column": float(average.col + 1)}
        for key in ("theta_bp", "phi_bp", "r_bp"):
            values[key] = _evaluate(model[key], values)
        azimuth, elevation = math.radians(values["theta_bp"]), math.radians(values["phi_bp"])
        radius = values["r_bp"] * _MM
        theta, phi, zeta = (math.radians(_evaluate(model[key], values)) for key in ("theta", "phi", "zeta"))
        length, curvature = math.exp(_evaluate(model["log_arc_length"], values)), _evaluate(model["curvature"], values)
        mounts.append(
            dataclasses.replace(
                average,
                # No cos φ in x and y, unlike spherical coordinates: WHISKiT places base points so.
                position=(radius * math.cos(azimuth), radius * math.sin(azimuth), radius * math.sin(elevation)),
                angles=(theta, phi, zeta),
                whisker=published_whisker(length, curvature, average.row, average.col, species=species),
            )
        )
    return WhiskerArray(species=species, mounts=tuple(mounts), citation=model["citation"])


def _evaluate(terms: dict[str, float], quantities: dict[str, float]) -> float:
    """Sum the terms of one equation: a constant and coefficients of known quantities or of their squares."""
    # The published equations are linear in row, column, the base-point coordinates and their squares.
    values = {"constant": 1.0, **quantities, **{f"{key}_squared": value**2 for key, value in quantities.items()}}
    return sum(factor * values[name] for name, factor in terms.items())


def _radii(arc_length: float, row: int, col: int, rule: dict[str, Any]) -> tuple[float, float]:
    """Return the base and tip radius [mm] by the rat equations of Belli et al. (2017); their row counts from 1."""
    base = rule["base_diameter"]
    slope = rule["radius_slope"]
    diameter = base["constant"] + base["arc_length"] * arc_length + base["row"] * (row + 1) + base["column"] * col
    taper = slope["constant"] + slope["row"] * (row + 1) + slope["column"] * col + slope["column_squared"] * col**2
    radius = diameter / 2
    # The tip has half of what the slope leaves of the base radius: the rule in the table (``tip_radius_rule``).
    return radius, max((radius - taper * arc_length) / 2, rule["tip_radius_floor_mm"])
