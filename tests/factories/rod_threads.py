"""A warp of a GPU played by Python: 32 threads that meet at every shuffle, running kernel source in double precision.

What groups of threads tell each other on a GPU cannot run elsewhere; here it can, slowly, and a shuffle that not all
threads of the warp reach together is an error.
"""

from __future__ import annotations

import re
import sys
import threading
from contextlib import contextmanager
from functools import partial
from types import FunctionType, ModuleType, SimpleNamespace

import numpy as np
from scipy.optimize import lsq_linear

from brainbench.geometry.mesh import point_triangle_distance
from brainbench.stimuli.engines.rod.kernels import specialize
from brainbench.stimuli.engines.rod.limits import WIDE

NONE_LEFT = 2**31 - 1


def _segments_apart(a, b, p, q):
    """Least squared distance of two segments."""
    return 2 * lsq_linear(np.stack([b - a, p - q], axis=1), p - a, bounds=(0, 1), method="bvls").cost


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


WARP = 32


class Memory(np.lib.mixins.NDArrayOperatorsMixin):
    """An array or a thread's memory: reading copies, writing counts."""

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: object, **options: object) -> object:
        """Calculate with the values."""
        return getattr(ufunc, method)(
            *(part.values if isinstance(part, Memory) else part for part in inputs), **options
        )

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __getitem__(self, key: object) -> object:
        found = self.values[key]
        return found.copy() if isinstance(found, np.ndarray) else found

    def __setitem__(self, key: object, value: object) -> None:
        self.values[key] = _values(value)


def _values(part: object) -> object:
    return part.values if isinstance(part, Memory) else part


class Records(Memory):
    """An array of Warp's, given as numpy's; elements of a structured one have fields that can be read and set."""

    def __getitem__(self, key: object) -> object:
        return _Record(self.values, key) if self.values.dtype.names else super().__getitem__(key)


class _Record:
    def __init__(self, values: np.ndarray, key: object) -> None:
        object.__setattr__(self, "_at", (values, key))

    def __getattr__(self, name: str) -> object:
        values, key = self._at
        found = values[name][key]
        if found.dtype.names:
            return SimpleNamespace(**{part: found[part].copy() for part in found.dtype.names})
        return found.copy() if isinstance(found, np.ndarray) else found

    def __setattr__(self, name: str, value: object) -> None:
        values, key = self._at
        if values[name].dtype.names:
            value = tuple(tuple(_values(getattr(value, part))) for part in values[name].dtype.names)
        values[name][key] = value


class ThreadWarp:
    """32 threads whose shuffles wait for each other."""

    def __init__(self) -> None:
        self._own = threading.local()
        self._meet = threading.Barrier(WARP)
        self._values: list = [None] * WARP
        self._places: list = [None] * WARP

    def run(self, work, threads: int = WARP) -> None:
        """Call ``work(thread)`` in each thread; raise the first error of any."""
        errors = []

        def go(thread: int) -> None:
            self._own.index = thread
            try:
                work(thread)
            except threading.BrokenBarrierError:
                pass
            except (ArithmeticError, LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
                errors.append(error)
                self._meet.abort()

        together = [threading.Thread(target=go, args=(index,)) for index in range(threads)]
        for thread in together:
            thread.start()
        for thread in together:
            thread.join()
        if errors:
            raise errors[0]

    def _exchange(self, value):
        index, caller = self._own.index, sys._getframe(2)
        self._values[index], self._places[index] = value, (caller.f_code, caller.f_lineno)
        self._meet.wait()
        values, places = list(self._values), set(self._places)
        self._meet.wait()
        if len(places) > 1:
            raise RuntimeError(f"threads of a warp shuffle at different places: {places}")
        return values

    def groups(self, size: int) -> dict:
        """Return what stands for the functions of :mod:`brainbench.stimuli.engines.rod.kernels.thread_groups`."""

        def mine(values):
            begin = self._own.index // size * size
            return values[begin : begin + size]

        return {
            "broadcast": lambda value, source: mine(self._exchange(value))[source],
            "group_sum": lambda value: sum(mine(self._exchange(value))),
            "group_max": lambda value: max(mine(self._exchange(value))),
            "group_min": lambda value: min(mine(self._exchange(value))),
            "group_min_int": lambda value: min(mine(self._exchange(value))),
            "group_or": lambda value: int(np.bitwise_or.reduce([int(bits) for bits in mine(self._exchange(value))])),
            "warp_max": lambda value: max(self._exchange(value)),
        }


def _language() -> ModuleType:
    """What kernel source asks of the module ``warp``, on numpy."""
    fake = ModuleType("warp")

    def vector(count, kind):
        return lambda *values: np.array(values, dtype=float) if values else Memory(np.zeros(count, dtype=kind))

    def bits(value, _kind):
        return int(np.float32(value).view(np.int32))

    def native(code):
        # Native code reads memory, or is where the processor's minimum and maximum are other than Warp's.
        if "extract(memory, index)" in code:
            return lambda _function: lambda memory, index: memory[index]
        if found := re.search(r"#else\nreturn a ([<>]) b \? a : b;", code):
            return lambda _function: min if found[1] == "<" else max
        children = re.search(r"constexpr int children = (\d+);", code)
        return lambda function: partial(NATIVES.get(function.__name__, function), int(children[1]) if children else 0)

    def zeroed(kind):
        def begin(self):
            for name, made in kind.__annotations__.items():
                setattr(self, name, made() if isinstance(made, type | FunctionType) else 0)

        kind.__init__ = begin
        return kind

    class Reference:
        def __class_getitem__(cls, _kind):
            return cls

    made = {
        "float32": np.float64, "float64": np.float64, "int32": int, "uint64": int,
        "types": SimpleNamespace(vector=vector, matrix=lambda shape, _kind: lambda *_: Memory(np.zeros(shape))),
        "kernel": lambda **_: lambda same: same,
        "static": lambda value: value, "func": lambda function=None, **_: function or (lambda same: same),
        "ref": Reference, "struct": zeroed, "func_native": native,
        **dict.fromkeys(["array", "array2d", "array3d", "array4d"], lambda **_: None),
        "min": min, "max": lambda a, b: max(b, a), "abs": abs, "sqrt": np.sqrt, "sin": np.sin, "cos": np.cos,
        "clamp": lambda x, low, high: min(max(x, low), high), "where": lambda yes, a, b: a if yes else b,
        "dot": lambda a, b: np.float64(a @ b), "cross": lambda a, b: np.array(
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]),
        "length": lambda a: np.sqrt(a @ a), "length_sq": lambda a: np.float64(a @ a),
        "normalize": lambda a: a / np.sqrt(a @ a), "cast": bits,
    }  # fmt: skip
    for name, value in made.items():
        setattr(fake, name, value)
    return fake


@contextmanager
def thread_warp():
    """Give a :class:`ThreadWarp` and ``load(module, group_size=…, …)`` for kernel modules made anew on it.

    The real modules come back after.
    """
    package = specialize.__module__
    kept = {name: module for name, module in sys.modules.items() if name == "warp" or name.startswith(f"{package}_")}
    threads = ThreadWarp()

    def load(module: str, **parameters: object) -> ModuleType:
        given = specialize("parameters", **parameters)
        groups = ModuleType(f"{given.__package__}.thread_groups")
        vars(groups).update(threads.groups(given.group_size))
        sys.modules[groups.__name__] = groups
        return specialize(module, **parameters)

    try:
        for name in kept:
            del sys.modules[name]
        sys.modules["warp"] = _language()
        yield threads, load
    finally:
        for name in [name for name in sys.modules if name == "warp" or name.startswith(f"{package}_")]:
            del sys.modules[name]
        sys.modules.update(kept)
