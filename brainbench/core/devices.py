"""Warp and MuJoCo, loaded late and quietly, and the devices they compute on."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.errors import UsageError, brief
from brainbench.core.files import cache_dir, check_folder, user_folder
from brainbench.core.lazy import lazy_module
from brainbench.core.reading.regular import temporary_folder

if TYPE_CHECKING:
    import torch
else:
    torch = lazy_module("torch")

_STARTING = threading.Lock()


def warp() -> Any:
    """Return the initialised module ``warp``."""
    with _STARTING:
        return _start()


@cache
def _start() -> Any:
    import warp as wp

    # Only errors: a user need not hear which devices there are, nor that kernels were compiled.
    wp.config.log_level = wp.LOG_ERROR
    wp.config.enable_backward = False
    try:
        check_folder(user_folder("WARP_CACHE_PATH", "user_cache_dir", "warp"), "Warp")
    except UsageError:  # no home folder, or a read-only one
        wp.config.kernel_cache_dir = str(cache_dir("kernels"))
    with _without_driver_warning():
        wp.init()
    return wp


_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


@contextlib.contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Keep back the line that Warp's native library writes to stderr on machines without an NVIDIA driver.

    Whoever asks for ``cuda`` there is told by :func:`pick_device`. All else that is written meanwhile follows after.
    """
    with temporary_folder() as folder, Path(folder, "stderr").open("w+b") as said:
        try:
            stderr = os.dup(2)
        except OSError:  # no stderr at all
            yield
            return
        os.dup2(said.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            said.seek(0)
            os.write(2, b"".join(line for line in said if _NO_DRIVER not in line))


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
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError) as error:
        raise UsageError(f"{name!r} is not a device; name cpu, cuda or cuda:N.") from error
    count = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= count:
        raise UsageError(f"There is no device {str(device)!r} here ({count} CUDA devices); name cpu instead.")
    return device


def to_struct(kind: Any, values: Mapping[str, np.ndarray], device: Any, *, copy: bool = True) -> Any:
    """Fill a Warp structure of arrays; empty arrays become one unused element.

    Arrays of records are structured, with the fields of the record in order. Without ``copy`` the structure may
    share memory with other structures and, on a processor, with ``values``: for kernels that only read it.
    """
    wp, struct = warp(), kind()
    unused = _unused.__wrapped__ if copy else _unused
    for name, value in values.items():
        dtype = kind.vars[name].type.dtype
        array = np.ascontiguousarray(value)
        if hasattr(dtype, "numpy_dtype"):
            record = np.dtype(dtype.numpy_dtype())
            if array.dtype.names != record.names:
                raise TypeError(f"{name} holds records of {record.names}; received {array.dtype.names}")
            array = array.astype(record)
        if array.size == 0:
            setattr(struct, name, unused(array.shape[1:], array.dtype, dtype, str(device)))
        else:
            setattr(struct, name, wp.array(array, dtype=dtype, device=device, copy=copy))
    return struct


@cache
def _unused(shape: tuple[int, ...], kind: np.dtype, dtype: Any, device: str) -> Any:
    """Return a Warp array of one element that stands for none."""
    return warp().array(np.zeros((1, *shape), dtype=kind), dtype=dtype, device=device)


_LOG = logging.getLogger(__name__)
WARM_UP = 3  # runs before a recording: they choose algorithms, fill caches and allocate


Recorder = Callable[[Callable[[], Any]], tuple[Any, Any]]
"""Records a piece of work, which does not run; returns its graph, whose ``replay()`` does it on the memory that it was
recorded with, and the tensors that replays fill."""


def record_torch(work: Callable[[], Any]) -> tuple[torch.cuda.CUDAGraph, Any]:
    """Record torch's work; a :data:`Recorder`."""
    graph = torch.cuda.CUDAGraph()
    # Other threads may work on the same device meanwhile.
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        result = work()
    return graph, result


class CudaGraphStep:
    """A piece of work that runs as it is at first, is then recorded, and from then on replayed.

    Args:
        work: Returns tensors in dictionaries and tuples, or None. Random numbers are those that it would draw
            unrecorded.
        recorder: :func:`record_torch`, or another that knows the same generators.
        subject: What is recorded, for messages: ``"The control step"``.
        advice: What to do if it cannot be, for the error where a recording is required.
        warm_up: Calls before the recording.
        aside: Make these calls on a stream of their own, as recordings are.
        generators: Random numbers that the work draws, beside torch's own.
        retained: Tensors of the result that last anyway and are returned themselves; others are returned as copies.
            None copies nothing: the next call overwrites what was returned.
        required: A recording that fails is an error; otherwise a warning, and the work runs launch by launch.
    """

    def __init__(
        self,
        work: Callable[..., Any],
        recorder: Recorder,
        *,
        subject: str,
        advice: str = "",
        warm_up: int = 2,
        aside: bool = False,
        generators: Sequence[torch.Generator] = (),
        retained: Sequence[torch.Tensor] | None = (),
        required: bool = False,
    ) -> None:
        self.work, self.recorder = work, recorder
        self._subject, self._advice, self._required = subject, advice, required
        self._left, self._aside, self._generators, self._kept = warm_up, aside, tuple(generators), retained
        self._graph: Any = None
        self._result: Any = None
        self.failed: str = ""
        """Reason why the work could not be recorded; empty if it was, or was not tried yet."""

    @property
    def recorded(self) -> bool:
        """True when the work is replayed."""
        return self._graph is not None

    def __call__(self, *subjects: Any) -> Any:
        """Do the work and return its result.

        Args:
            *subjects: What the work takes, the same objects in every call.
        """
        warming = self._left > 0
        self._left -= 1
        if self._graph is None and not self.failed and not warming:
            self._record(lambda: self.work(*subjects))
        if self._graph is None:
            with side_stream() if self._aside and warming else contextlib.nullcontext():
                return self.work(*subjects)
        self._graph.replay()
        return self._result if self._kept is None else _copied(self._result, self._kept)

    def _record(self, work: Callable[[], Any]) -> None:
        states = [generator.get_state() for generator in self._generators]
        try:
            self._graph, self._result = self.recorder(work)
        except (RuntimeError, UsageError) as error:
            self.failed = _reason(error)
            self._release_generators(states)
            failure = f"{self._subject} cannot be recorded as a CUDA graph"
            if self._required:
                raise UsageError(f"{failure}: {self.failed}. {self._advice}".rstrip()) from error
            _LOG.warning("%s and runs launch by launch, which is slower: %s", failure, self.failed)

    def _release_generators(self, states: Sequence[torch.Tensor]) -> None:
        """Take generators out of the recording that broke off: one that ends well does."""
        if not self._generators:
            return
        try:
            self.recorder(lambda: [torch.rand(1, generator=g, device=g.device) for g in self._generators])
        except RuntimeError as error:
            _LOG.warning("Random numbers may not recover from a recording that broke off: %s", _reason(error))
        for generator, state in zip(self._generators, states, strict=True):
            generator.set_state(state)


def record_step(work: Callable[[], None], device: torch.device) -> Callable[[], Any]:
    """Run torch's work :data:`WARM_UP` times and record it; return what repeats it. On the CPU that is ``work`` itself.

    It reads and writes tensors that stay where they are; what the first runs change (weights, counters) stays changed.
    """
    with side_stream(device) if device.type == "cuda" else contextlib.nullcontext() as side:
        for _ in range(WARM_UP):
            work()
    if side is None:
        return work
    side.synchronize()
    graph, _ = record_torch(work)
    return graph.replay


def record_launches(work: Callable[[], None], device: Any) -> Callable[[], None]:
    """Record launches of Warp on a CUDA device, which do not run, and return what launches them all."""
    wp = warp()
    with no_collection(), wp.ScopedCapture(device=device) as capture:
        work()
    graph = capture.graph
    return lambda: wp.capture_launch(graph)


@contextlib.contextmanager
def side_stream(device: torch.device | None = None) -> Iterator[torch.cuda.Stream]:
    """Work on a new stream of torch, after all that was asked for before and before all that is asked for later."""
    side = torch.cuda.Stream(device)
    side.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(side):
        yield side
    torch.cuda.current_stream(device).wait_stream(side)


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Put off the collection of garbage, which could free device memory and so end a recording."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _copied(result: Any, retained: Sequence[torch.Tensor]) -> Any:
    if isinstance(result, dict):
        return {name: _copied(value, retained) for name, value in result.items()}
    if isinstance(result, tuple):
        return tuple(_copied(value, retained) for value in result)
    return result if result is None or any(result is one for one in retained) else result.clone()


def _reason(error: BaseException) -> str:
    """Return in one line what broke a recording; the end of the recording, which fails too, hides it."""
    first = error.__context__ or error
    return str(first).strip().split("\n")[0] or type(first).__name__
