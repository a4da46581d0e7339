"""What stands for native code of the kernels where :mod:`tests.factories.rod_threads` runs their source in Python."""

from __future__ import annotations

import numpy as np

from brainbench.geometry.mesh import point_triangle_distance
from brainbench.stimuli.engines.rod.limits import WIDE

NONE_LEFT = 2**31 - 1


def _segments_apart(a, b, p, q):
    """Least squared distance of two segments: of an end of one from the other, or between their lines."""

    def from_segment(x, start, stop):
        along = stop - start
        share = np.clip((x - start) @ along / max(along @ along, 1e-300), 0, 1)
        return float(np.sum((x - start - share * along) ** 2))

    ends = [from_segment(a, p, q), from_segment(b, p, q), from_segment(p, a, b), from_segment(q, a, b)]
    matrix = np.stack([b - a, p - q], axis=1)
    places, _, rank, _ = np.linalg.lstsq(matrix, p - a, rcond=None)
    if rank == 2 and (places >= 0).all() and (places <= 1).all():
        ends.append(float(np.sum((matrix @ places - (p - a)) ** 2)))
    return min(ends)


def _segment_triangle(a, b, corners):
    """Squared distance of a segment from the edges of a triangle; 0 where it pierces the face."""
    matrix = np.stack([corners[1] - corners[0], corners[2] - corners[0], a - b], axis=1)
    if abs(np.linalg.det(matrix)) > 1e-24:
        v, w, share = np.linalg.solve(matrix, a - corners[0])
        if min(v, w, share, 1 - share, 1 - v - w) >= 0:
            return 0.0
    return min(_segments_apart(a, b, corners[k], corners[k - 1]) for k in range(3))


def measure_triangles(children, corners, leaf, first, count, part, line, _bounds, got):
    own = range(min(children, count - first))
    triangles = [corners[leaf][:, children * part + k].reshape(3, 3) for k in own]
    for k, triangle in enumerate(triangles):
        ends = [float(point_triangle_distance(x[None], triangle[None])[0]) ** 2 for x in (line.b, line.a)]
        for name, face, square in (
            ("side", "face", _segment_triangle(line.a, line.b, triangle)),
            ("end", "end_face", ends[0]),
            ("start", "start_face", ends[1]),
        ):
            if square < getattr(got, name):
                setattr(got, name, square)
                setattr(got, face, first + k)


def bound_boxes(children, boxes, node, part, line, _bounds, level, side, end):
    for k in range(children):
        low, high = boxes[node][:, children * part + k].reshape(2, 3)
        ends = np.stack([line.a, line.b])
        gap = np.maximum(np.maximum(low - ends.max(axis=0), ends.min(axis=0) - high), 0)
        away = np.maximum(np.maximum(low - line.b, line.b - high), 0)
        side[level, k], end[level, k] = gap @ gap, away @ away


def nearest_child(children, side, end, level, part, bounds):
    code = NONE_LEFT
    for k in range(children):
        if side[level, k] < bounds.side or end[level, k] < bounds.end:
            bits = int(np.float32(side[level, k]).view(np.int32))
            code = min(code, (bits & -WIDE) + children * part + k)
    return code


def pass_joint(_children, joints, joint, twists, step, _each, unit):
    j, w, v = joints[joint], unit.w.values, unit.v.values

    def rates(which):
        motion = getattr(j, f"motion{which}")
        return motion.w @ w + motion.v @ v

    def pass_on(which, rate):
        gain = getattr(j, f"gain{which}")
        w[:] -= np.outer(gain.w, rate)
        v[:] -= np.outer(gain.v, rate)

    inverse = j.inverse_inertia
    if twists:
        unit.joint_rate.values[2] = rates(3)
        unit.impulse.values[2] = step * inverse[3] * unit.joint_rate.values[2]
        pass_on(3, unit.joint_rate.values[2])
    u = unit.joint_rate.values[:2]
    u[:] = rates(1), rates(2)
    unit.impulse.values[:2] = step * np.array([inverse[:2], inverse[1:3]]) @ u
    pass_on(1, u[0])
    pass_on(2, u[1])


def joint_rate(_children, unit, hinge, row):
    return unit.joint_rate.values[hinge, row]


def _columns(matrix, rows, contact):
    return matrix.values.reshape(-1, rows)[3 * contact : 3 * contact + 3]


def add_joint(_children, unit, contact, rate1, rate2, rate3, twists, _first, _each, matrix):
    impulse = unit.impulse.values
    columns = _columns(matrix, impulse.shape[1], contact)
    columns += np.outer(rate1, impulse[0]) + np.outer(rate2, impulse[1])
    if twists:
        columns += np.outer(rate3, impulse[2])


def clear(_children, matrix, _count, _each):
    matrix.values[:] = 0


def add_rates(_children, own, matrix, contact, force, _each):
    own.rate.values += force @ _columns(matrix, len(own.rate.values), contact)


NATIVES = {
    function.__name__: function
    for function in (measure_triangles, bound_boxes, nearest_child, pass_joint, joint_rate, add_joint, clear, add_rates)
}
"""By the name of the kernels' function; the first argument is the number of children that one thread looks at."""
