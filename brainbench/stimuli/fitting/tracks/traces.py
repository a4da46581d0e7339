"""Traces of many points that differ from frame to frame, made one array: which end is the base, and how many points.

A trace is points [k, 2 or 3] in the unit of its file.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def stack_traces(
    traces: Mapping[int, Array], follicles: Mapping[int, Array], most: int
) -> tuple[NDArray[np.int_], Array]:
    """Return frame numbers [n] and points [n, k, 2 or 3] of traces by frame, base first, NaN behind the last.

    Frames between the first and the last that have no trace are NaN. Traces with more than ``most`` points lose some of
    them evenly: neighbours of a trace share the noise of their pixels, and more points would tell no more.
    """
    frames = np.arange(min(traces), max(traces) + 1)
    known = sorted(traces)
    oriented = orient({frame: traces[frame] for frame in known}, follicles)
    axes = next(iter(traces.values())).shape[1]
    points = np.full((len(frames), min(most, max(len(one) for one in traces.values())), axes), np.nan)
    for frame, trace in oriented.items():
        picked = np.unique(np.linspace(0, len(trace) - 1, min(len(trace), most)).round().astype(int))
        points[frame - frames[0], : len(picked)] = trace[picked]
    return frames, points


def orient(traces: Mapping[int, Array], follicles: Mapping[int, Array]) -> dict[int, Array]:
    """Return the traces with their base first: the end nearer to the follicle where that is known.

    Else ends are followed from frame to frame, and the base is the one that moves less.
    """
    found: dict[int, Array] = {}
    unknown: list[int] = []
    before: Array | None = None
    for frame, trace in traces.items():
        if frame in follicles:
            near = np.linalg.norm(trace[[0, -1]] - follicles[frame], axis=1)
            trace = trace if near[0] <= near[1] else trace[::-1]
        else:
            unknown.append(frame)
            if before is not None:
                same = np.linalg.norm(trace[0] - before[0]) + np.linalg.norm(trace[-1] - before[-1])
                swapped = np.linalg.norm(trace[-1] - before[0]) + np.linalg.norm(trace[0] - before[-1])
                trace = trace if same <= swapped else trace[::-1]
        found[frame] = before = trace
    if len(unknown) == len(found):
        ends = np.array([[trace[0], trace[-1]] for trace in found.values()])
        moved = ends.std(axis=0).sum(axis=1)
        if moved[0] > moved[1]:
            found = {frame: trace[::-1] for frame, trace in found.items()}
    return found
