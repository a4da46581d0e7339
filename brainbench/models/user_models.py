"""A user's own model, from a file or an installed module, without registering it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, UsageError
from brainbench.core.plugins import load_object
from brainbench.models.ops.seeding import seeded

if TYPE_CHECKING:
    from torch import nn


def load_user_model(target: str, *, seed: int = 0) -> nn.Module:
    """Build a model from ``path/to/file.py:name`` or ``package.module:name``, in evaluation mode.

    ``name`` is a class or function without required arguments, or a ready module. The file's own folder
    can be imported from while it loads. Random weights follow from the seed (CPU generator).

    Raises:
        UsageError: the target is not of this form, has no such name, or does not give a :class:`torch.nn.Module`.
        DataError: the file or module cannot be imported, or building the model fails.
    """
    with seeded(seed):
        return build_user_model(target).eval()


def build_user_model(target: str, **options: Any) -> nn.Module:
    """Build a model from its code with the random state as it is; see :func:`load_user_model`."""
    from torch import nn

    made = load_object(target, "model")
    if callable(made) and not isinstance(made, nn.Module):
        try:
            made = made(**options)
        except Exception as error:
            given = f"with {', '.join(options)}" if options else "without arguments"
            raise DataError(
                f"Building the model {target!r} failed with {type(error).__name__}: {error} (it is called {given})."
            ) from error
    return check_module(made, target)


def check_module(made: Any, target: str) -> nn.Module:
    """Return what a user's or another package's code made, which must be a module.

    Raises:
        UsageError: it is something else.
    """
    from torch import nn

    if not isinstance(made, nn.Module):
        raise UsageError(f"{target!r} gave a {type(made).__name__}, not a torch.nn.Module; return the model itself.")
    return made
