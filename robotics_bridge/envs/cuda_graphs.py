"""Parts of a control step as CUDA graphs: hundreds of small launches of torch and Warp become one."""

from __future__ import annotations

import contextlib
import gc
import logging
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError

if TYPE_CHECKING:
    import torch

_LOG = logging.getLogger(__name__)


class Captured:
    """A part of a step that runs as it is at first, is then recorded, and from then on replayed.

    A recording must neither copy from the host nor wait for it, its shapes must not depend on data, and Python values
    that it reads stay what they were. Random numbers of the generator are those that the part would draw unrecorded.

    Args:
        work: the part; it returns tensors in dictionaries and tuples, or None.
        generator: of its random numbers.
        device: Warp device.
        kept: tensors of the result that last anyway and are returned themselves; others are returned as copies.
        required: whether a part that cannot be recorded is an error.
        warm: calls before the recording, which compile and allocate.
    """

    def __init__(
        self,
        work: Callable[..., Any],
        generator: torch.Generator,
        device: Any,
        *,
        kept: Sequence[torch.Tensor] = (),
        required: bool = False,
        warm: int = 2,
    ) -> None:
        self._work, self._generator, self._device = work, generator, device
        self._kept = tuple(kept)
        self._required, self._left = required, warm
        self._graph: Any = None
        self._result: Any = None
        self.failed: str = ""
        """Why the part could not be recorded; empty if it was, or was not tried yet."""

    @property
    def recorded(self) -> bool:
        """Whether the part is replayed."""
        return self._graph is not None

    def __call__(self, *subjects: Any) -> Any:
        """Run the part and return its result.

        Args:
            *subjects: what the part takes, the same objects in every call.

        Raises:
            UsageError: the part is required to be recorded and cannot be.
        """
        if self._graph is None and not self.failed and self._left <= 0:
            self._try(lambda: self._work(*subjects))
        self._left -= 1
        if self._graph is None:
            return self._work(*subjects)
        self._graph.replay()
        return _copied(self._result, self._kept)

    def _try(self, work: Callable[[], Any]) -> None:
        state = self._generator.get_state()
        try:
            self._graph, self._result = self._record(work)
        except (RuntimeError, UsageError) as error:
            self.failed = _reason(error)
            self._heal(state)
            if self._required:
                raise UsageError(
                    f"The control step cannot be recorded as a CUDA graph: {self.failed}. Terms and watches of a task "
                    "may not copy from the processor or wait for it (brainbench.core.rotations.constant keeps "
                    "constants on the device); change them, or make the environment with graphs=False."
                ) from error
            _LOG.warning(
                "The control step cannot be recorded as a CUDA graph and runs launch by launch, which is slower: %s",
                self.failed,
            )

    def _record(self, work: Callable[[], Any]) -> tuple[Any, Any]:
        """Return the graph of a piece of work, which does not run, and the tensors that replays fill."""
        import torch

        wp = warp()
        where = wp.device_to_torch(self._device)
        # What Python throws away meanwhile could free device memory, which ends a recording.
        gc.collect()
        own = torch.cuda.ExternalStream(self._device.stream.cuda_stream, device=where)
        graph, side = torch.cuda.CUDAGraph(), torch.cuda.Stream(where)
        graph.register_generator_state(self._generator)
        stream = wp.stream_from_torch(side)
        with contextlib.ExitStack() as scope:
            scope.enter_context(_no_collection())
            scope.enter_context(torch.cuda.device(where))
            # A recording that breaks off leaves torch on its stream.
            scope.enter_context(torch.cuda.stream(torch.cuda.current_stream(where)))
            # Results outlive the caller's inference mode, tensors of which no gradient could ever pass.
            scope.enter_context(torch.inference_mode(False))
            scope.enter_context(torch.no_grad())
            scope.enter_context(torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"))
            # Waiting for Warp's own stream would tie the recording to work outside of it.
            scope.enter_context(wp.ScopedStream(stream, sync_enter=False))
            result = work()
        return _Graph(graph, own), result

    def _heal(self, state: torch.Tensor) -> None:
        """Take generators out of the recording that broke off: one that ends well does."""
        import torch

        try:
            self._record(lambda: torch.rand(1, generator=self._generator, device=self._generator.device))
        except RuntimeError as error:
            _LOG.warning("Random numbers may not recover from a recording that broke off: %s", _reason(error))
        self._generator.set_state(state)


class _Graph:
    """A recorded graph that is replayed on torch's stream, between what Warp does on its own."""

    def __init__(self, graph: torch.cuda.CUDAGraph, warp_stream: torch.cuda.Stream) -> None:
        self._graph, self._warp = graph, warp_stream

    def replay(self) -> None:
        """Do it again."""
        import torch

        current = torch.cuda.current_stream(self._warp.device)
        current.wait_stream(self._warp)
        self._graph.replay()
        self._warp.wait_stream(current)


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _copied(result: Any, kept: Sequence[torch.Tensor]) -> Any:
    if isinstance(result, dict):
        return {name: _copied(value, kept) for name, value in result.items()}
    if isinstance(result, tuple):
        return tuple(_copied(value, kept) for value in result)
    return result if result is None or any(result is one for one in kept) else result.clone()


def _reason(error: BaseException) -> str:
    """Return in one line what broke a recording; the end of the recording, which fails too, hides it."""
    first = error.__context__ or error
    return str(first).strip().split("\n")[0] or type(first).__name__
