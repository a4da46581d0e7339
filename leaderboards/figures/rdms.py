"""Pictures of representational dissimilarity matrices: one pixel per cell, in colours that colour-blind readers see."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from brainbench.core.errors import visible_lines
from leaderboards.boards import RAW_INPUT, Board
from leaderboards.figures import svg
from leaderboards.ranking import DOUBTFUL
from leaderboards.text import number

# Nine equidistant colours of viridis (van der Walt & Smith 2015), perceptually uniform and safe for
# colour-blind readers.
_VIRIDIS = ("440154", "472d7b", "3b528b", "2c728e", "21918c", "28ae80", "5ec962", "addc30", "fde725")
_LEVELS = 254
MOST_GROUPS = 60  # most points of a line over pairs of stimuli


@dataclass(frozen=True)
class RdmPicture:
    """An RDM as a PNG of one pixel per cell, with what a reader needs beside it."""

    source: str
    """``data:`` address of the image; the diagonal is transparent, pairs without a value are grey."""
    labels: tuple[str, ...]
    low: float
    high: float
    description: str
    """The picture in words, for readers who do not see it."""


def rdm_panel(board: Board) -> svg.Figure:
    """Draw the RDMs of the raw input, of the best models of each kind and of the brain (figure 3.5 a to d)."""
    key, title = "rdms", "Representational dissimilarity (as figure 3.5)"
    picked = _picked(board)
    size = len(board.conditions)
    pictures = [(name, detail, rdm_picture(pairs, board.conditions)) for name, detail, pairs in picked]
    drawn = [(name, detail, picture) for name, detail, picture in pictures if picture is not None]
    if not drawn:
        return svg.Figure(key, title, lacking="no record holds RDMs")
    side = min(svg.WIDTH / len(drawn) - 16, 170.0)
    drawing = svg.Drawing(svg.WIDTH, side + 72, f"{len(drawn)} dissimilarity matrices of {size} stimuli")
    for index, (name, detail, picture) in enumerate(drawn):
        x0 = index * (svg.WIDTH / len(drawn))
        drawing.text(x0, 13, name, "title")
        drawing.text(x0, 28, svg.cut(detail, max(12, int(side / 6.3))), "quiet small")
        draw_rdm(drawing, x0, 38, side, picture)
        draw_range(drawing, x0, side + 46, side, picture)
    caption = (
        "Each cell is the dissimilarity of two stimuli in the order of the records "
        f"({', '.join(board.conditions[:8])}{', …' if size > 8 else ''}); dark is alike, bright is different, each "
        "matrix over its own range (the bar below it), as comparisons by correlation ignore scale."
    )
    return svg.Figure(key, title, caption, drawing)


def rdm_lines(board: Board) -> svg.Figure:
    """Draw the same RDMs as lines over the pairs of stimuli, each scaled to fit the brain's (figure 3.5 e).

    Pairs stand in the order of the brain's dissimilarity; many pairs are averaged in groups of equal size.
    """
    key, title = "rdm-lines", "Flattened dissimilarity matrices (as figure 3.5 e)"
    picked = {name: np.asarray(pairs, dtype=np.float64) for name, _, pairs in _picked(board)}
    truth = picked.pop("brain", np.empty(0))
    models = [(name, pairs) for name, pairs in picked.items() if pairs.shape == truth.shape]
    if not models:
        return svg.Figure(key, title, lacking="no record holds the RDMs of a model and of the brain")
    finite = np.isfinite([truth, *(pairs for _, pairs in models)]).all(axis=0)
    if finite.sum() < 3:
        return svg.Figure(key, title, lacking="fewer than 3 pairs of stimuli are defined in all RDMs")
    order = np.argsort(truth[finite], kind="stable")
    groups = np.array_split(order, min(len(order), MOST_GROUPS))
    lines = [("brain", truth[finite])]
    for name, pairs in models:
        # Comparisons by correlation ignore scale and offset: least squares puts each RDM on the brain's.
        flat = np.ptp(pairs[finite]) == 0
        slope, offset = (0.0, truth[finite].mean()) if flat else np.polyfit(pairs[finite], truth[finite], 1)
        lines.append((name, offset + slope * pairs[finite]))
    drawing = svg.Drawing(svg.WIDTH, 300, f"{len(lines)} flattened dissimilarity matrices of {finite.sum()} pairs")
    means = [np.array([values[group].mean() for group in groups]) for _, values in lines]
    across = svg.Scale(0, len(groups) - 1, 56, svg.WIDTH - 170)
    up = svg.scale_of(np.concatenate(means).tolist(), 262, 16, floor=None)
    svg.left_axis(drawing, up, 56, svg.WIDTH - 170)
    drawing.text((56 + svg.WIDTH - 170) / 2, 286, "pairs of stimuli, by the brain's dissimilarity", "mid")
    for place, values in enumerate(means):
        points = "L".join(f"{across.at(i):.1f} {up.at(value):.1f}" for i, value in enumerate(values))
        drawing.path(f"M{points}", f"trace c{place}")
    svg.legend(drawing, [(name, "square", f"c{place}") for place, (name, _) in enumerate(lines)], svg.WIDTH - 156)
    few = f" in {len(groups)} groups" if len(groups) < finite.sum() else ""
    caption = (
        f"{finite.sum()} pairs of stimuli{few} in the order of the brain's dissimilarity; the other matrices are "
        "scaled to it by least squares. A line that rises with the brain's orders the pairs as the brain does."
    )
    return svg.Figure(key, title, caption, drawing)


def _picked(board: Board) -> list[tuple[str, str, Sequence[float]]]:
    """Return name, detail and pairs of the RDMs that are shown, the brain's last."""
    entries = board.entries
    picked: list[tuple[str, str, Sequence[float]]] = []
    raw = next((b.score for b in board.baselines if b.name == RAW_INPUT), None)
    if raw is not None and raw.model_rdm:
        picked.append((RAW_INPUT, f"score {number(raw.scaled)}", raw.model_rdm))
    for label, test in (
        ("supervised", lambda e: e.card.objective == "supervised"),
        ("self-supervised", lambda e: e.trained and e.card.objective != "supervised"),
        ("untrained", lambda e: not e.trained),
    ):
        best = next((e for e in entries if e.score.model_rdm and e.standing not in DOUBTFUL and test(e)), None)
        if best is not None:
            picked.append((f"best {label}", f"{best.name}, {best.score.layer}", best.score.model_rdm))
    brain = next((e.score.brain_rdm for e in entries if e.score.brain_rdm), ())
    if brain:
        picked.append(("brain", board.recordings, brain))
    return picked


def rdm_picture(pairs: Sequence[float], labels: Sequence[str]) -> RdmPicture | None:
    """Draw an RDM given as its upper triangle [P], row by row; None when there are no pairs to draw.

    The colours span this RDM's own range, because comparisons by correlation ignore scale.
    """
    size = len(labels)
    if size < 2 or len(pairs) != size * (size - 1) // 2:
        return None
    values, places = np.asarray(pairs, dtype=np.float64), np.column_stack(np.triu_indices(size, k=1))
    finite = np.isfinite(values)
    if not finite.any():
        return None
    low, high = float(values[finite].min()), float(values[finite].max())
    alike, apart = places[values == low][0], places[values == high][-1]
    scale = (_LEVELS - 1) / (high - low) if high > low else 0.0
    cells = np.where(np.eye(size), -1, _LEVELS)
    rows, columns = places[finite].T
    cells[rows, columns] = cells[columns, rows] = np.rint((values[finite] - low) * scale)
    description = (
        f"{size} by {size} matrix of dissimilarities from {low:.3g} to {high:.3g}; most alike are "
        f"{labels[alike[0]]} and {labels[alike[1]]}, most different {labels[apart[0]]} and {labels[apart[1]]}."
    )
    if not finite.all():
        description += f" Undefined pairs: {np.sum(~finite)}."
    return RdmPicture(_png(cells), tuple(labels), low, high, description)


def colour_stops() -> tuple[tuple[float, str], ...]:
    """Return (offset in percent, colour) for the legend's gradient."""
    return tuple((100 * i / (len(_VIRIDIS) - 1), f"#{colour}") for i, colour in enumerate(_VIRIDIS))


def draw_rdm(drawing: svg.Drawing, x: float, y: float, side: float, picture: RdmPicture) -> None:
    """Put the picture of an RDM into a drawing, its pixels unblurred."""
    place = f'x="{x:.1f}" y="{y:.1f}" width="{side:.1f}" height="{side:.1f}"'
    drawing.rect(x, y, side, side, "box")
    drawing.parts.append(
        f'<image {place} image-rendering="pixelated" href="{picture.source}">'
        f"<title>{escape(visible_lines(picture.description))}</title></image>"
    )


def draw_range(drawing: svg.Drawing, x: float, y: float, width: float, picture: RdmPicture) -> None:
    """Draw the bar of an RDM's colours with the dissimilarities at its ends."""
    place = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="7"'
    bar = _png(np.arange(_LEVELS)[None])
    drawing.parts.append(f'<image {place} preserveAspectRatio="none" href="{bar}"/>')
    drawing.text(x, y + 19, f"{picture.low:.3g}", "quiet small")
    drawing.text(x + width, y + 19, f"{picture.high:.3g}", "quiet small end")


def _png(cells: np.ndarray) -> str:
    """Encode colour levels (−1: transparent) as an indexed PNG (W3C recommendation, third edition).

    The palette holds only the colours in use: most RDMs are small, and a page holds hundreds.
    """
    used, index = np.unique(cells, return_inverse=True)
    stops = np.array([list(bytes.fromhex(stop)) for stop in _VIRIDIS]).T
    shares = used / (_LEVELS - 1) * (len(_VIRIDIS) - 1)
    palette = np.rint([np.interp(shares, range(len(_VIRIDIS)), stop) for stop in stops]).T
    palette[used < 0], palette[used == _LEVELS] = 0, 128
    rows = np.pad(index.reshape(cells.shape), ((0, 0), (1, 0)))
    data = b"\x89PNG\r\n\x1a\n"
    for kind, body in (
        (b"IHDR", struct.pack(">IIBBBBB", cells.shape[1], len(cells), 8, 3, 0, 0, 0)),
        (b"PLTE", palette.astype(np.uint8).tobytes()),
        (b"tRNS", b"\x00" if used[0] < 0 else b"\xff"),
        (b"IDAT", zlib.compress(rows.astype(np.uint8).tobytes(), 9)),
        (b"IEND", b""),
    ):
        data += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return "data:image/png;base64," + base64.b64encode(data).decode()
