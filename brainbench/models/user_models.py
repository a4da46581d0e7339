"""Models of the user's own: built from a file or an installed module, and known by name to the command line.

``brainbench models add FILE.py:NAME --name still`` writes the name, the place of the code and its hash into one JSON
file. The code stays where it is and is read whenever the model is built. Models of packages arrive by entry points
instead (:mod:`~brainbench.models.registry`).
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError, check_name
from brainbench.core.files import CONFIG_VARIABLE, check_folder, content_hash, read_json, settings_dir, write_json
from brainbench.core.plugins import files_of, foreign_code, load_object
from brainbench.models.architecture import check_new_name

if TYPE_CHECKING:
    from torch import nn

FAMILY = "user module"
"""Family of models whose code is not in the registry of a package; boards set them apart."""
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class UserModel:
    """A model that the user added."""

    name: str
    target: str
    """``/path/to/FILE.py:NAME`` or ``package.module:NAME``."""
    hash: str = ""
    """Hash of the file, and of what it imports from its folder, when it was added; empty for a module."""

    @property
    def path(self) -> Path | None:
        """The file; None for a module."""
        place = self.target.rpartition(":")[0]
        return Path(place) if place.endswith(".py") else None

    def build(self, **options: Any) -> nn.Module:
        """Build the model from its code as it is today; a change since it was added is told in a warning.

        Raises:
            DataFileNotFoundError: the file is gone.
        """
        if self.path is not None and not self.path.is_file():
            raise DataFileNotFoundError(
                f"The model {self.name!r} was added from {str(self.path)!r}, which is gone; put the file back, or "
                f"take the name away with: brainbench models remove {self.name}"
            )
        model = build_user_model(self.target, **options)
        if self.path is not None and content_hash(*files_of(self.path)) != self.hash:
            _LOG.warning(
                "%s, or what it imports from its folder, has changed since the model %r was added; it is used as it is "
                "now.", self.path, self.name,
            )  # fmt: skip
        return model


def load_user_model(target: str, *, seed: int = 0) -> nn.Module:
    """Build a model from ``path/to/file.py:name`` or ``package.module:name``, in evaluation mode.

    ``name`` is a class or function without required arguments, or a ready module. The file's own folder
    can be imported from while it loads. Random weights follow from the seed (CPU generator).
    """
    from brainbench.models.ops.layers import seeded

    with seeded(seed):
        return build_user_model(target).eval()


def build_user_model(target: str, **options: Any) -> nn.Module:
    """Build a model from its code with the random state as it is; see :func:`load_user_model`."""
    from torch import nn

    builder = load_object(target, "model")
    if callable(builder) and not isinstance(builder, nn.Module):
        given = f"with {', '.join(options)}" if options else "without arguments"
        with foreign_code(f"Building the model {target!r}", f" (it is called {given})"):
            builder = builder(**options)
    return check_module(builder, target)


def check_module(module: Any, target: str) -> nn.Module:
    """Return what a user's or another package's code made, which must be a module."""
    from torch import nn

    if not isinstance(module, nn.Module):
        raise UsageError(f"{target!r} gave a {type(module).__name__}, not a torch.nn.Module; return the model itself.")
    return module


def settings_file() -> Path:
    """Return the file of the added models, in ``$BRAINBENCH_CONFIG`` or the platform's folder of settings."""
    return settings_dir() / "models.json"


def read_user_models() -> dict[str, UserModel]:
    """Return the added models by name."""
    path = settings_file()
    stored = read_json(path) if path.is_file() else {}
    fields = {"target", "hash"}
    if not isinstance(stored, dict) or not all(
        isinstance(entry, dict) and entry.keys() == fields and all(isinstance(text, str) for text in entry.values())
        for entry in stored.values()
    ):
        raise DataError(f"{str(path)!r} is not what brainbench models add writes; remove it and add your models again.")
    return {name: UserModel(name, **item) for name, item in stored.items()}


def add_user_model(target: str, name: str, *, names: Collection[str]) -> UserModel:
    """Store a model of the user's own under a name; nothing is stored unless it can be built.

    ``target`` is ``path/to/FILE.py:NAME`` or ``package.module:NAME``; ``names`` are those of the registry. Raises
    UsageError: the name is taken or breaks the grammar, or the target gives no module; DataFileNotFoundError: there is
    no such file or module; DataError: the code fails, or the settings cannot be written.
    """
    check_new_name(name)
    models = read_user_models()
    if name in models or name in names:
        hint = f"; or first: brainbench models remove {name}" if name in models else ""
        raise UsageError(f"There is already a model named {name!r}; choose another name{hint}.")
    place, _, part = target.rpartition(":")
    if place.endswith(".py"):
        place = str(Path(place).expanduser().resolve())
        target = f"{place}:{part}"
    check_folder(settings_file().parent, CONFIG_VARIABLE)
    load_user_model(target)
    model = UserModel(name, target, content_hash(*files_of(Path(place))) if place.endswith(".py") else "")
    _write({**models, name: model})
    return model


def remove_user_model(name: str) -> UserModel:
    """Take a stored name away and return what it stood for; the file with the code stays."""
    models = read_user_models()
    check_name("model of your own", name, models)
    model = models.pop(name)
    _write(models)
    return model


def _write(models: dict[str, UserModel]) -> None:
    write_json(settings_file(), {item.name: {"target": item.target, "hash": item.hash} for item in models.values()})
