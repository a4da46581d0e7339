"""Models by name.

A name is ``<encoder>[-<cell>][-ln][-small][+<attender>][.<tag>]``. Without a tag the model is untrained;
its weights follow from the seed alone. ``local-dir:PATH`` and ``hf-hub:OWNER/NAME`` name a folder of trained
weights (:mod:`~brainbench.models.training.checkpoints`). Other packages add models through the entry point group
``brainbench.models``: an entry point names a module (or an object in it) whose import runs
:func:`register_model`; Importing this module imports no framework.

The user adds models for the command line: ``brainbench models add FILE.py:NAME --name still`` writes the name, the
place of the code and its hash into one JSON file. The code stays where it is and is read whenever the model is built.
"""

from __future__ import annotations

import functools
import inspect
import logging
import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass, fields, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from brainbench.core.errors import (
    DataError,
    DataFileNotFoundError,
    UsageError,
    check_kind,
    check_name,
    unknown_name,
)
from brainbench.core.files import (
    CONFIG_VARIABLE,
    check_folder,
    content_hash,
    read_json,
    read_mapping,
    settings_dir,
    write_json,
)
from brainbench.core.lazy import lazy_module
from brainbench.core.plugins import files_of, foreign_code, load_entry_points, load_object
from brainbench.core.reading.regular import user_path
from brainbench.models.recipes import OBJECTIVES, Architecture, check_new_name
from brainbench.models.training.checkpoints import PREFIXES, WEIGHTS, find_folder, load_weights, read_config, shipped

if TYPE_CHECKING:
    import torch
    from torch import nn

    from brainbench.models import proof
    from brainbench.models.ops import layers
else:
    torch, nn = lazy_module("torch"), lazy_module("torch.nn")
    proof, layers = lazy_module("brainbench.models.proof"), lazy_module("brainbench.models.ops.layers")

FAMILY = "user module"  # family of models whose code is not in the registry of a package; boards set them apart
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
        """Build the model from its code as it is today; a change since it was added is told in a warning."""
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
    with layers.seeded(seed):
        return build_user_model(target).eval()


def build_user_model(target: str, **options: Any) -> nn.Module:
    """Build a model from its code with the random state as it is; see :func:`load_user_model`."""
    builder = load_object(target, "model")
    if callable(builder) and not isinstance(builder, nn.Module):
        given = f"with {', '.join(options)}" if options else "without arguments"
        with foreign_code(f"Building the model {target!r}", f" (it is called {given})"):
            builder = builder(**options)
    return check_module(builder, target)


def check_module(module: Any, target: str) -> nn.Module:
    """Return what a user's or another package's code made, which must be a module."""
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
        place = str(user_path(place).resolve())
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


ENTRY_POINTS = "brainbench.models"
SIZES = Path(__file__).with_name("sizes.json")  # sizes of the models that come with the package, by name


@dataclass(frozen=True)
class ModelFacts:
    """Facts stated of an architecture when it is registered."""

    name: str
    family: str
    description: str
    citation: str
    licence: str


@dataclass(frozen=True)
class ModelRecord(ModelFacts):
    """One architecture of the registry."""

    build: Callable[..., nn.Module]
    """Builds the model with new random weights; takes no argument that is required."""

    @property
    def source(self) -> str:
        """Top-level package that the code comes from."""
        function = self.build.func if isinstance(self.build, partial) else self.build
        return "user" if self.family == FAMILY else function.__module__.partition(".")[0]


@dataclass(frozen=True)
class ModelSize:
    """Size and cost of a network."""

    parameters: int
    multiply_adds: int | None
    """Multiply-adds of a time step, counted on the first one (attention to earlier steps adds under 0.2 % to
    the 22nd of ``+gpt``); None for a model without a method ``multiply_adds``."""
    layers: tuple[str, ...]
    """Layers that can be extracted by name."""


@dataclass(frozen=True)
class ModelDescription(ModelSize, ModelFacts):
    """Record of an architecture with its size and cost, known without building its weights."""

    source: str
    """Top-level package that the code comes from."""
    trained: Mapping[str, Any] | None = None
    """For a name of trained weights: what their configuration says."""


_records: dict[str, ModelRecord] = {}
_loaded: set[str] = set()

Factory = TypeVar("Factory", bound="Callable[..., nn.Module]")


def register_model(
    name: str, *, family: str, description: str = "", citation: str = "", licence: str = "unstated"
) -> Callable[[Factory], Factory]:
    """Decorate a function that builds a model, so that it can be had by name.

    It is called without arguments, or with the options that a user or a checkpoint gives; a model that is to be
    trained on other data takes ``classes``.

    Args:
        name: Lower-case letters, digits, ``-`` and ``+``.
        family: Architecture family, for grouping on leaderboards.
        description: One line for people.
        citation: Paper the architecture comes from.
        licence: Licence of the code (weights carry their own).

    Example:
        >>> @register_model("tiny-linear", family="linear")
        ... def tiny_linear():
        ...     from torch import nn
        ...     return nn.Sequential(nn.Flatten(2), nn.Linear(1050, 10))
        >>> "tiny-linear" in list_models("tiny*")
        True
    """
    check_new_name(name)

    def _decorate(build: Factory) -> Factory:
        if name in _records:
            owner = _records[name].build
            raise UsageError(f"A model named {name!r} is already registered by {owner!r}; choose another name.")
        _records[name] = ModelRecord(name, family, description, citation, licence, build)
        return build

    return _decorate


def list_models(pattern: str = "*") -> list[str]:
    """Return the names of the architectures that match a shell pattern, such as ``*+gpt``."""
    return [name for name in _known() if fnmatchcase(name, pattern)]


@dataclass(frozen=True)
class LocatedModel:
    """Meaning of a name: the registered architecture, and where its weights are if it is a trained one."""

    name: str
    record: ModelRecord
    architecture: Architecture
    """Parts of the name."""
    trained: Mapping[str, Any] | None = None
    """Configuration of the trained weights; None without a folder of them."""
    weights: Path | None = None
    """Safetensors file; None for untrained weights, and where there are none yet."""

    def build(self, seed: int = 0, **options: Any) -> nn.Module:
        """Build the model with its weights, in evaluation mode; untrained weights follow from the seed alone."""
        if self.weights is None and self.architecture.tag is not None:
            raise UsageError(
                f"There are no weights for {self.name!r} yet; train them with: brainbench train "
                f"{self.architecture.untrained} --objective {self.architecture.tag}; or load the untrained model "
                f"{self.architecture.untrained!r}."
            )
        model = self._drawn(seed, options)
        if self.weights is not None:
            load_weights(model, self.weights, what=self.name)
        data: Any = (self.trained or {}).get("data")
        spec: Any = getattr(model, "spec", None)
        if data and hasattr(spec, "trained_on"):
            model.spec = spec.trained_on(data)
        return model.eval()

    def outline(self) -> nn.Module:
        """Build the model without allocating its weights, to count them."""
        try:
            return self._drawn(0, {}, "meta")
        except (RuntimeError, NotImplementedError):  # a model that computes with values while it is built
            return self._drawn(0, {})

    def _drawn(self, seed: int, options: Mapping[str, Any], device: str = "cpu") -> nn.Module:
        # A program's own default device would draw other numbers.
        with layers.seeded(seed), torch.device(device):
            return self._make(options)

    def _make(self, options: Mapping[str, Any]) -> nn.Module:
        options = {**(self.trained["options"] if self.trained else {}), **options}
        accepted = inspect.signature(self.record.build).parameters
        for option in options:
            if option not in accepted and not any(item.kind is item.VAR_KEYWORD for item in accepted.values()):
                raise unknown_name(f"option of the model {self.record.name!r}", option, accepted)
        return check_module(self.record.build(**options), self.record.name)


def locate_model(name: str, pretrained: str | os.PathLike[str] | None = None) -> LocatedModel:
    """Find what a name stands for, without building anything; arguments and errors are those of :func:`load_model`."""
    check_kind("name of a model", name, str, "a text")
    is_path = name.startswith(PREFIXES)
    if is_path and pretrained is not None:
        raise UsageError(f"{name!r} already names trained weights; pretrained is for registry names with a tag.")
    given = Path(pretrained) if pretrained is not None and Path(pretrained).is_dir() else None
    folder = find_folder(name) if is_path else given or (shipped().get(name) if pretrained is None else None)
    trained = None if folder is None else read_config(folder)
    full_name = trained["architecture"] if is_path and trained else name
    parts, records = Architecture.parse(full_name), _known()
    if parts.untrained not in records:
        # A tag stays in the suggestion: the untrained model is another one.
        choices = records if parts.tag is None else [*shipped(), *(f"{item}.{parts.tag}" for item in records)]
        raise unknown_name("model", full_name, choices, hint="See them all with: brainbench models")
    if parts.tag is not None and parts.tag not in OBJECTIVES:
        raise unknown_name(f"weights tag of {parts.untrained!r}", parts.tag, OBJECTIVES)
    if parts.tag is None and pretrained is not None:
        raise UsageError(
            f"Without a tag {name!r} is the untrained model; name the objective its weights were trained with, "
            f"for example {name}.{OBJECTIVES[0]!s}, to load {os.fspath(pretrained)!r}."
        )
    weights = folder / WEIGHTS if folder is not None else None if pretrained is None else Path(pretrained)
    # A look-up returns a copy: nobody changes the registry by what it gave.
    return LocatedModel(name, replace(records[parts.untrained]), parts, trained, weights)


def load_model(
    name: str, *, seed: int = 0, pretrained: str | os.PathLike[str] | None = None, **options: Any
) -> nn.Module:
    """Build a model by name, in evaluation mode.

    Args:
        name: ``architecture`` (untrained), ``architecture.tag`` (trained with that objective), or a folder of
            trained weights as ``local-dir:PATH`` or ``hf-hub:OWNER/NAME[@REVISION]``.
        seed: Seed of untrained weights. Equal seeds give equal weights whatever else drew random
            numbers, and PyTorch's global random state is left as it was.
        pretrained: Folder of a checkpoint, or safetensors file, with the weights of a tagged name.
        **options: What the architecture's builder takes; ours take ``classes``, ``decoder`` and ``unroll``.
    """
    return locate_model(name, pretrained).build(seed, **options)


def describe_model(name: str) -> ModelDescription:
    """Return a model's record with its size and cost, computed without allocating its weights."""
    located = locate_model(name)
    record, is_ours = located.record, located.record.source == __name__.partition(".")[0]
    # Sizes of the models that come with the package are shipped: to measure all of them takes half a minute.
    size = (_shipped_sizes().get(name) if is_ours else None) or measure(located)
    label = record.name if located.trained is None else name
    facts = {field.name: getattr(record, field.name) for field in fields(ModelFacts)} | {"name": label}
    return ModelDescription(**facts, **asdict(size), source=record.source, trained=located.trained)


def measure(located: LocatedModel) -> ModelSize:
    """Count a network's parameters and multiply-adds."""
    model = located.outline()
    count: Callable[[], int] | None = getattr(model, "multiply_adds", None)
    parameters = sum(parameter.numel() for parameter in model.parameters())
    return ModelSize(parameters, count() if count is not None else None, proof.named_layers(model) or ())


@functools.cache
def _shipped_sizes() -> dict[str, ModelSize]:
    # Written by tests/factories/model_sizes.py and held by tests/models/test_registry.py.
    stated = read_mapping(SIZES, "file of the sizes of models")
    return {name: ModelSize(**{**size, "layers": tuple(size["layers"])}) for name, size in stated.items()}


def _known() -> dict[str, ModelRecord]:
    """Return the registry, with what other packages and the user add entered on first use."""
    if ENTRY_POINTS not in _loaded:
        _loaded.add(ENTRY_POINTS)
        load_entry_points(ENTRY_POINTS, lambda name, model: None)
        for added in read_user_models().values():
            if added.name in _records:
                _LOG.warning("The model %r of a package hides the one that you added (%s).", added.name, added.target)
                continue
            _records[added.name] = ModelRecord(
                added.name, FAMILY, f"added from {added.target}", "", "unstated", added.build
            )
    return _records
