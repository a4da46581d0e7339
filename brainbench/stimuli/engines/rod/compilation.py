"""Kernels of the whisker solver, compiled when a machine first needs them and kept by Warp."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from brainbench.core.devices import warp
from brainbench.stimuli.engines.rod.limits import CONTACT_BOUNDS, DISTANCE_BOUNDS, MESHES
from brainbench.stimuli.engines.rod.slices import lock_of


def load_kernels(
    device: Any,
    real: type,
    capacity: int,
    needs: int = MESHES,
    *,
    hinges: int = 2,
    recorder: str = "",
    yields: bool = False,
    compiling: Callable[[bool], None] | None = None,
    **options: Any,
) -> Any:
    """Return the kernels for chains of at most ``capacity`` links on a device, ready to be launched.

    On a processor one kernel serves whatever there is to touch: what a scene does not use costs it nothing there, while
    every further kernel would cost its compilation. Threads may ask at once; each kernel is compiled once.

    ``compiling`` is called with True before compiling and with False after it, not at all for kernels that Warp has
    kept. Everything else is as for :func:`brainbench.stimuli.engines.rod.kernels.build_kernels`; of ``options`` a
    processor knows ``sliced`` alone.
    """
    from brainbench.stimuli.engines.rod.kernels import BUILDING, build_kernels

    kind = {"hinges": hinges, "recorder": recorder} | ({"yields": True} if yields else {})
    with BUILDING:
        if device.is_cuda:
            kernels = build_kernels(real, capacity, needs, cuda=True, **kind, **options)
        else:
            kernels = build_kernels(real, capacity, sliced=options.get("sliced", False), **kind)
    if device.is_cuda and options.get("sliced"):
        with kernels.loading, lock_of(device):
            _load_together(kernels, options["bounds"][0], device)
        return kernels
    if device.is_cuda and options:  # compiled at their launch, for the blocks that it asks for
        return kernels
    block = 1 if device.is_cpu else None
    with kernels.loading:
        module = kernels.run.module
        compiled = Path(warp().config.kernel_cache_dir, module.get_module_identifier(block)).is_dir()
        tell = (lambda begins: None) if compiled or compiling is None else compiling
        tell(True)
        module.load(device, block_dim=block)
        tell(False)
    return kernels


def _load_together(kernels: Any, block: int, device: Any) -> None:
    """Load the kernels of whiskers in slices; those that this machine does not have yet compile side by side."""
    blocks = {kernels.run: block, kernels.swap_queues: None, kernels.measure_distances: DISTANCE_BOUNDS[0]}
    blocks |= {kernel: CONTACT_BOUNDS[0] for kernel, _ in kernels.solve_contacts}
    with ThreadPoolExecutor(len(blocks)) as pool:
        list(pool.map(lambda kernel: kernel.module.load(device, block_dim=blocks[kernel]), blocks))
