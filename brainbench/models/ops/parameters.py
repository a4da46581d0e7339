"""Parameters of modules: loaded by name (all or nothing), and drawn from a seed that disturbs nobody."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn

from brainbench.core.errors import DataError, UsageError, listing, nearest
from brainbench.core.files import content_hash
from brainbench.core.reading.ranges import check_number


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Run a block with PyTorch's CPU generator at ``seed``; its state is put back afterwards."""
    # PyTorch keeps seeds as signed 64-bit numbers.
    check_number("seed", seed, least=0, below=2**63, whole=True)
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        yield


def load_named(targets: Mapping[str, torch.Tensor], state: Mapping[str, Any], *, what: str) -> None:
    """Copy arrays or tensors of ``state`` into ``targets``, which has the same names; all or nothing."""
    check_named({name: tuple(value.shape) for name, value in targets.items()}, state, what=what)
    copy_named(targets, state)


def check_named(shapes: Mapping[str, tuple[int, ...]], state: Mapping[str, Any], *, what: str) -> None:
    """Compare the names and shapes of ``state`` with the expected ones."""
    problems = []
    missing = [name for name in shapes if name not in state]
    unexpected = [name for name in state if name not in shapes]
    if missing:
        problems.append(f"missing {listing(missing)}")
    if unexpected:
        guesses = {name: nearest(name, shapes) for name in unexpected[:3]}
        hints = ", ".join(f"{name!r} → {guess!r}?" for name, guess in guesses.items() if guess)
        problems.append(f"unexpected {listing(unexpected)}" + (f" (did you mean {hints})" if hints else ""))
    wrong = [
        f"{name!r} has shape {list(state[name].shape)}, expected {list(shape)}"
        for name, shape in shapes.items()
        if name in state and tuple(state[name].shape) != shape
    ]
    if wrong:
        described = "; ".join(wrong[:4]) + (f"; and {len(wrong) - 4} more" if len(wrong) > 4 else "")
        problems.append(f"shapes that do not fit: {described}")
    if problems:
        raise DataError(f"The parameters do not fit {what}: {'; '.join(problems)}.")


def check_weights(module: nn.Module, name: str) -> None:
    """Raise UsageError for a module whose weights do not exist yet."""
    values = [*module.named_parameters(), *module.named_buffers()]
    if lazy := [label for label, value in values if nn.parameter.is_lazy(value)]:
        raise UsageError(
            f"{name} has lazy layers without weights yet ({', '.join(lazy[:3])}): run it once, on zeros of shape "
            "[1, 22, 30, 5, 7] for instance, before you return it."
        )
    if empty := [label for label, value in values if value.is_meta]:
        raise UsageError(
            f"{name} has weights that were never loaded ({', '.join(empty[:3])} on the device 'meta'): load them, or "
            "build it on a device that holds numbers."
        )


def weights_hash(module: nn.Module) -> str:
    """Return the hash of a module's parameters and buffers."""
    state = {name: value.detach().cpu() for name, value in module.state_dict().items()}
    # NumPy has no bfloat16; single precision holds its numbers.
    plain = {name: value.float() if value.dtype == torch.bfloat16 else value for name, value in state.items()}
    return content_hash(*(part for name in sorted(plain) for part in (name, plain[name].numpy())))


@torch.no_grad()
def copy_named(targets: Mapping[str, torch.Tensor], state: Mapping[str, Any]) -> None:
    """Copy checked arrays or tensors into the targets of the same names."""
    for name, target in targets.items():
        target.copy_(torch.as_tensor(state[name]))
