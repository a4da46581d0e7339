"""A warp of a GPU played by Python: 32 threads that meet at every shuffle, running kernel source in double precision.

What groups of threads tell each other on a GPU cannot run elsewhere; here it can, slowly, and a shuffle that not all
threads of the warp reach together is an error.
"""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from types import FunctionType, ModuleType, SimpleNamespace

import numpy as np

from brainbench.stimuli.engines.rod.kernels import specialize

WARP = 32


class Memory(np.lib.mixins.NDArrayOperatorsMixin):
    """An array or a thread's memory: reading copies, writing counts."""

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: object, **options: object) -> object:
        """Calculate with the values."""
        return getattr(ufunc, method)(*map(values_of, inputs), **options)

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __getitem__(self, key: object) -> object:
        found = self.values[key]
        return found.copy() if isinstance(found, np.ndarray) else found

    def __setitem__(self, key: object, value: object) -> None:
        self.values[key] = values_of(value)


def values_of(part: object) -> object:
    """Return what a thread's memory holds; other values as they are."""
    return part.values if isinstance(part, Memory) else part


class ThreadWarp:
    """32 threads whose shuffles wait for each other."""

    def __init__(self) -> None:
        self._own = threading.local()
        self._meet = threading.Barrier(WARP)
        self._values: list = [None] * WARP
        self._places: list = [None] * WARP

    def run(self, work, threads: int = WARP) -> None:
        """Call ``work(thread)`` in each thread; raise the first error of any."""

        def go(thread: int) -> None:
            self._own.index = thread
            try:
                work(thread)
            except threading.BrokenBarrierError:  # of another thread's error
                pass
            except BaseException:
                self._meet.abort()
                raise

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(go, range(threads)))

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


def _language(natives: Mapping[str, Callable[..., object]]) -> ModuleType:
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
        children = [int(count) for count in re.findall(r"constexpr int children = (\d+);", code)]
        return lambda function: partial(natives.get(function.__name__, function), *children)

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
def thread_warp(*functions: Callable[..., object]):
    """Give a :class:`ThreadWarp` and ``load(module, group_size=…, …)`` for kernel modules made anew on it.

    Native ``functions`` of the kernels are given in Python, by their names; the first argument of those that look at
    children is the number that one thread looks at. The real modules come back after.
    """
    natives = {function.__name__: function for function in functions}
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
        sys.modules["warp"] = _language(natives)
        yield threads, load
    finally:
        for name in [name for name in sys.modules if name == "warp" or name.startswith(f"{package}_")]:
            del sys.modules[name]
        sys.modules.update(kept)
