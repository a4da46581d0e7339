"""Device, clock and launches that the parts of a suite share, and where each sensor's reading lies.

Letters: B environment, N probe, C channel; readings are stored planar [C, B, N].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from inspect import get_annotations
from typing import Annotated, Any, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import warp
from brainbench.core.limits import annotation_of
from robotics_bridge.sensors.noise.model import Noise

_MOST = 512  # packed launches that are kept


def numbers_of(*configs: type) -> Callable[[type], type]:
    """Give a Warp structure a field for every number, pair or triple that configurations themselves state.

    Numbers that may be None are left to the structure. Stands below ``@wp.struct``.
    """

    def _decorate(cls: type) -> type:
        numbers = {}
        for config in configs:
            stated = [field.name for field in fields(config) if field.name in get_annotations(config)]
            numbers |= {name: _dtype(annotation_of(config, name)) for name in stated}
        numbers = {name: dtype for name, dtype in numbers.items() if dtype}
        cls.__annotations__ = {**numbers, **get_annotations(cls)}
        return cls

    return _decorate


def _dtype(annotation: Any) -> Any:
    """Return the Warp type of a number or of several, None for anything else."""
    wp = warp()
    if get_origin(annotation) is Annotated:
        return _dtype(annotation.__origin__)
    if get_origin(annotation) is tuple:
        kinds = tuple(map(_dtype, get_args(annotation)))
        return {(wp.float32,) * 2: wp.vec2f, (wp.float32,) * 3: wp.vec3f, (wp.int32,) * 3: wp.vec3i}.get(kinds)
    return {float: wp.float32, int: wp.int32, bool: wp.int32}.get(annotation)


def fill(kind: Any, *sources: Any, **values: Any) -> Any:
    """Return a Warp structure: its fields as given, or as the attributes of configurations that bear their names."""
    struct = kind()
    for name in kind.vars:
        given = values[name] if name in values else next(getattr(s, name) for s in sources if hasattr(s, name))
        setattr(struct, name, given)
    return struct


@dataclass(eq=False)
class LaunchContext:
    """Device of kernels, counters of updates and episodes, and what random numbers depend on."""

    num_envs: int
    """B."""
    device: Any
    """Warp device."""
    seed: int
    env_offset: int
    """Number, in the whole experiment, of environment 0."""

    def __post_init__(self) -> None:
        self._packed: dict[tuple[Any, ...], tuple[Any, tuple[Any, ...]]] = {}
        self.age: Any = self.array(np.full(self.num_envs, -1), int)
        """Warp array [B]: updates since the environment's reset, 0 at the first."""
        self.episode: Any = self.zeros(self.num_envs, int)
        """Warp array [B]: resets so far."""

    def launch(self, kernel: Any, dim: int | Sequence[int], *inputs: Any, block: int = 256) -> None:
        """Run a kernel, on a GPU by ``block`` threads together; on a processor, what is launched again is packed once.

        Packing the arguments takes Warp 12 µs, which is most of a small update there. Structures may change between
        launches, arrays must not move.
        """
        if self.device.is_cuda:
            warp().launch(kernel, dim=dim, inputs=inputs, device=self.device, block_dim=block)
            return
        dim = dim if isinstance(dim, int) else tuple(dim)
        key = (kernel, dim, *(value if isinstance(value, int | float) else id(value) for value in inputs))
        if key not in self._packed:
            if len(self._packed) >= _MOST:
                self._packed.clear()
            packed = warp().launch(kernel, dim=dim, inputs=inputs, device=self.device, record_cmd=True)
            # What an address stands for must live as long as the address is remembered.
            self._packed[key] = packed, inputs
        # Warp packs nothing where there is no thread to run.
        if packed := self._packed[key][0]:
            packed.launch()

    def array(self, values: Any, dtype: Any) -> Any:
        """Copy values to the device as a Warp array."""
        return warp().array(values, dtype=dtype, device=self.device)

    def zeros(self, shape: int | Sequence[int], dtype: Any = float) -> Any:
        """Return a Warp array of zeros on the device."""
        return warp().zeros(shape, dtype=dtype, device=self.device)


@dataclass(frozen=True)
class ReadoutSlice:
    """The probes of one sensor within a planar array [C, B, N]."""

    name: str
    """Name of the sensor, for its random numbers."""
    noise: Noise
    start: int
    """Its first probe on N."""
    layout: tuple[int, ...]
    """(n,) or (ny, nx)."""
    scalar: bool = False
    """True if a reading has no channel axis."""
    active: NDArray[np.bool_] | None = None
    """[n] False for fillers, which read 0; None if there are none."""

    @property
    def count(self) -> int:
        """Number of probes."""
        return math.prod(self.layout)

    @property
    def span(self) -> slice:
        """Its probes on N."""
        return slice(self.start, self.start + self.count)
