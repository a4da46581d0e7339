"""Warp and MuJoCo, loaded late and quietly, and the devices they compute on."""

from __future__ import annotations

import os
import re
import tempfile
import threading
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.errors import MissingDependencyError, UsageError, brief

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import torch


_STARTING = threading.Lock()


def warp() -> Any:
    """Return the initialised module ``warp``."""
    with _STARTING:
        return _start()


@cache
def _start() -> Any:
    try:
        import warp as wp
    except ImportError as error:
        raise MissingDependencyError(
            "Whisker and tactile simulation need warp-lang; install it with: pip install 'warp-lang>=1.19'"
        ) from error
    # Only errors: a user need not hear which devices there are, nor that kernels were compiled.
    wp.config.log_level = wp.LOG_ERROR
    wp.config.enable_backward = False
    with _without_driver_warning():
        wp.init()
    return wp


_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


@contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Keep back the line that Warp's native library writes to stderr on machines without an NVIDIA driver.

    Whoever asks for ``cuda`` there is told by :func:`pick_device`. All else that is written meanwhile follows after.
    """
    try:
        stderr = os.dup(2)
    except OSError:  # no stderr at all
        yield
        return
    try:
        with tempfile.TemporaryFile() as said:
            os.dup2(said.fileno(), 2)
            try:
                yield
            finally:
                os.dup2(stderr, 2)
                said.seek(0)
                rest = b"".join(line for line in said if _NO_DRIVER not in line)
                if rest:
                    os.write(2, rest)
    finally:
        os.close(stderr)


def usable_processors() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def mujoco_module() -> Any:
    """Return the module ``mujoco``; its names are made at run time, so type checkers do not know them."""
    return import_module("mujoco")


def pick_device(name: Any) -> Any:
    """Return the Warp device called ``cpu``, ``cuda`` or ``cuda:1``, or like a torch device; a Warp device passes.

    ``auto`` is the processor, or the GPU where this build of Warp lacks the compiler for processors.
    """
    wp = warp()
    if name is None or isinstance(name, wp.Device):
        return wp.get_device(name)
    name = str(name)  # torch devices are called as Warp's are
    if name == "auto":
        name = "cuda" if not wp.is_cpu_available() and wp.is_cuda_available() else "cpu"
    if not re.fullmatch(r"cpu|cuda(:\d{1,9})?", name):
        raise UsageError(f"A device is 'cpu', 'cuda' or 'cuda:N'; received {brief(name)}.")
    if name != "cpu" and int(name.partition(":")[2] or 0) >= (count := wp.get_cuda_device_count()):
        raise UsageError(f"There are {count} CUDA devices here, so {name!r} cannot be used; use 'cpu' or another one.")
    if name == "cpu" and not wp.is_cpu_available():
        hint = "install the one from PyPI, or use the engine 'mujoco'"
        raise UsageError(f"This build of warp-lang has no compiler for processors; {hint}.")
    return wp.get_device(name)


def gpus() -> list[str]:
    """Return the names of the visible CUDA devices, as ``CUDA_VISIBLE_DEVICES`` takes them; none is a UsageError."""
    pick_device("cuda")
    count = warp().get_cuda_device_count()
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    return [str(place) for place in range(count)] if given is None else given.split(",")[:count]


def torch_device(name: Any) -> torch.device:
    """Return the torch device called ``cpu``, ``cuda`` or ``cuda:1``; a torch device passes through."""
    import torch

    try:
        device = torch.device(name)
    except (RuntimeError, TypeError) as error:
        raise UsageError(f"{name!r} is not a device; name cpu, cuda or cuda:N.") from error
    count = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= count:
        raise UsageError(f"There is no device {str(device)!r} here ({count} CUDA devices); name cpu instead.")
    return device


def to_struct(kind: Any, values: Mapping[str, np.ndarray], device: Any) -> Any:
    """Fill a Warp structure of arrays; empty arrays become one unused element.

    Arrays of records are structured, with the fields of the record in order.
    """
    wp = warp()
    struct = kind()
    for name, value in values.items():
        dtype = kind.vars[name].type.dtype
        array = np.ascontiguousarray(value)
        if array.size == 0:
            array = np.zeros((1, *array.shape[1:]), dtype=array.dtype)
        if hasattr(dtype, "numpy_dtype"):
            record = np.dtype(dtype.numpy_dtype())
            if array.dtype.names != record.names:
                raise TypeError(f"{name} holds records of {record.names}; received {array.dtype.names}")
            array = array.astype(record)
        setattr(struct, name, wp.array(array, dtype=dtype, device=device))
    return struct
