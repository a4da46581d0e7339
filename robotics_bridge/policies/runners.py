"""Exported policies as functions of one step of one hand; a file is tried before it may move anything."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.errors import BrainbenchError, DataError
from brainbench.core.reading.regular import check_file
from brainbench.core.reading.tensors import check_finite
from brainbench.models.export import onnx_session, require_onnx
from robotics_bridge.policies.schema import MOST_NUMBERS

if TYPE_CHECKING:
    from numpy.typing import NDArray

Runner = Callable[[Mapping[str, "NDArray[np.float32]"], bool], "NDArray[np.float32]"]
"""(groups of one row [n…], forget first) → actions [A]."""
MOST_POLICY = 2 << 30
"""Bytes of a policy's file, which Protocol Buffers allow."""


def read_policy(
    path: str | Path, shapes: Mapping[str, tuple[int, ...]], *, threads: int | None = None, actions: int | None = None
) -> Runner:
    """Return an exported policy as a function of one step of one hand that remembers.

    Args:
        shapes: Group → shape, in the order of the contract's ``inputs``.
        threads: Threads that ONNX Runtime computes with; its own choice if None.
        actions: A; not checked if None.
    """
    require_onnx()
    check_file(path, "policy", most=MOST_POLICY)
    try:
        run: Runner = _OnnxRunner(path, shapes, threads)
        # A step of zeros shows here, and not with a hand in motion, what a file computes.
        tried = run({name: np.zeros(shape, np.float32) for name, shape in shapes.items()}, True)
    except BrainbenchError:
        raise
    except Exception as error:  # ONNX and ONNX Runtime have no common public base of errors
        first = str(error).strip().partition("\n")[0][:80]
        raise DataError(f"{str(path)!r} cannot be read as an ONNX policy ({first}).") from error
    if tried.ndim != 1 or (actions is not None and len(tried) != actions):
        raise DataError(f"{str(path)!r} gives actions of shape {tried.shape}; its contract has {actions}.")
    if not np.isfinite(tried).all():
        raise DataError(f"{str(path)!r} gives actions that are not finite; export the policy again.")
    return run


class _OnnxRunner:
    def __init__(self, path: str | Path, shapes: Mapping[str, tuple[int, ...]], threads: int | None) -> None:
        import onnx

        # Weights in other files are refused: a policy is one file, and it must not make us open others.
        tensors = list(_tensors(onnx.load(str(path), load_external_data=False)))
        if any(item.external_data for item in tensors):
            raise DataError(f"{str(path)!r} keeps weights in other files; export the policy again.")
        check_finite({item.name: onnx.numpy_helper.to_array(item) for item in tensors}, str(path))
        self.session = onnx_session(path, threads)
        inputs = {item.name: item.shape for item in self.session.get_inputs()}
        if missing := sorted({*shapes, "h_in"} - set(inputs)):
            raise DataError(
                f"The exported policy has no input {missing[0]!r} (it has {', '.join(inputs)}), so a part of the "
                "policy was lost on the way."
            )
        self.names, self.size = tuple(shapes), int(inputs["h_in"][1])
        if not 0 < self.size <= MOST_NUMBERS:
            raise DataError(f"{str(path)!r} has a memory of {self.size:,} numbers; 1 to {MOST_NUMBERS:,} are allowed.")
        self.state = np.zeros((1, self.size), np.float32)

    def __call__(self, obs: Mapping[str, NDArray[np.float32]], forget: bool = False) -> NDArray[np.float32]:
        if forget:
            self.state = np.zeros((1, self.size), np.float32)
        feed = {name: np.asarray(obs[name], np.float32)[None] for name in self.names}
        actions, self.state = self.session.run(["actions", "h_out"], {**feed, "h_in": self.state})
        return np.asarray(actions)[0]


def _tensors(message: Any) -> Iterator[Any]:
    """Yield all tensors of an ONNX message: weights, constants of nodes, and those of branches and functions."""
    if message.DESCRIPTOR.name == "TensorProto":
        yield message
        return
    for field, value in message.ListFields():
        if field.message_type is not None:
            for item in (value,) if hasattr(value, "DESCRIPTOR") else value:
                yield from _tensors(item)
