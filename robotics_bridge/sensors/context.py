"""Device, clock and launches that the parts of a suite share, and where each sensor's reading lies.

Letters: B environment, N probe, C channel; readings are stored planar [C, B, N].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import warp
from robotics_bridge.sensors.noise.model import Noise

_MOST = 512  # packed launches that are kept


def fill(kind: Any, source: Any, **fields: Any) -> Any:
    """Return a Warp structure: its fields as given, or as the attributes of a configuration that bear their names."""
    struct = kind()
    for name in kind.vars:
        setattr(struct, name, fields[name] if name in fields else getattr(source, name))
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
