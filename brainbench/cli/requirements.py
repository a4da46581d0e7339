"""Requirements of each command: packages of extras, a cache that can be written, and numbers that are numbers.

One table for all commands; it is asked when the command line is read, before anything slow.
"""

from __future__ import annotations

import functools
import inspect
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.output import Output, printed
from brainbench.core.errors import UsageError, missing_dependency
from brainbench.core.files import CACHE_VARIABLE, cache_dir, check_folder
from brainbench.core.reading.hdf5 import LINKED_VARIABLE


@dataclass(frozen=True)
class Requirement:
    """Packages that some options of a command need."""

    packages: tuple[str, ...]
    """Names of modules."""
    extra: str
    purpose: str
    when: Callable[[Mapping[str, Any]], bool] = lambda values: True
    """Test of the values of the command's parameters: true if they need them."""


def _given(*names: str) -> Callable[[Mapping[str, Any]], bool]:
    return lambda values: any(values.get(name) is not None for name in names)


def _ends(name: str, *suffixes: str) -> Callable[[Mapping[str, Any]], bool]:
    return lambda values: str(values.get(name) or "").lower().endswith(suffixes)


DISTRIBUTIONS = {
    "rsl_rl": "rsl-rl-lib", "imageio_ffmpeg": "imageio-ffmpeg", "sklearn": "scikit-learn", "skfem": "scikit-fem",
}  # fmt: skip
"""Packages whose name for pip is another one than that of the module."""
_PICTURES = Requirement(("matplotlib",), "report", "Drawing pictures")
PICTURES_IF_PLOT = replace(_PICTURES, when=_given("plot"))
_MP4 = Requirement(("imageio_ffmpeg",), "report", "Writing an MP4")
_POLICIES = Requirement(("rsl_rl", "tensordict"), "policies", "Training policies")
_CLUSTER = Requirement(("distributed",), "cluster", "A --scheduler", _given("scheduler"))
_ONNX = Requirement(
    ("onnx", "onnxscript", "onnxruntime"), "export", "Exporting to ONNX",
    lambda values: values.get("format", "onnx") == "onnx",
)  # fmt: skip
_PDF = Requirement(
    ("weasyprint",), "board", "A report as PDF",
    lambda values: (values.get("format") or str(values.get("out") or "").rpartition(".")[2]) == "pdf",
)  # fmt: skip

EXTRAS: dict[str, tuple[Requirement, ...]] = {
    "export": (_ONNX,),
    "policy export": (_ONNX,),
    "policy train": (replace(_POLICIES, packages=(*_POLICIES.packages, "tensorboard")),),
    "policy distill": (_POLICIES,),
    "policy sweep": (replace(_POLICIES, when=lambda values: not (values.get("count") or values.get("names"))),),
    "policy play": (
        replace(_PICTURES, when=_given("video")), replace(_MP4, when=_ends("video", ".mp4")),
    ),
    "policy deploy": (Requirement(("pyarrow",), "board", "Writing a LeRobot data set", _given("record")),),
    "stimuli render": (_PICTURES, replace(_MP4, when=_ends("out", ".mp4"))),
    "stimuli plot": (_PICTURES,),
    "stimuli separability": (Requirement(("sklearn",), "learn", "Separability"),),
    "stimuli sweep": (_CLUSTER,),
    "leaderboard add": (_CLUSTER,),
    "leaderboard report": (_PDF,),
    "tactile demo": (_PICTURES, Requirement(("skfem",), "tactile", "The sound of a struck ball")),
}  # fmt: skip

CACHED = (
    "score", "train", "stimuli simulate", "stimuli render", "stimuli plot", "stimuli separability",
    "tactile demo", "tactile bench", "policy play", "policy train", "policy evaluate", "policy distill",
    "leaderboard add", "leaderboard verify",
)  # fmt: skip
"""Commands that keep what they compute in the cache."""
FOREIGN = (
    "score", "recordings inspect", "recordings rdm", "recordings compare", "recordings check", "recordings export",
    "stimuli show", "stimuli plot", "stimuli render", "stimuli separability", "stimuli fit", "power",
)  # fmt: skip
"""Commands that read HDF5 files of others."""


@dataclass(frozen=True)
class Needs:
    """What a command needs before it starts."""

    packages: tuple[Requirement, ...] = ()
    cache: bool = False
    """Whether the command keeps what it computes in the cache."""


def needs(*packages: Requirement, cache: bool = False) -> Callable[[Callable[..., Output]], Callable[..., Output]]:
    """Decorate a command, outermost, with what it needs."""

    def mark(command: Callable[..., Output]) -> Callable[..., Output]:
        command.needs = Needs(packages, cache)  # type: ignore[attr-defined]
        return command

    return mark


def needs_of(name: str, command: Callable[..., Any] | None) -> Needs:
    """Return what a command needs: what it was decorated with, else what the tables say."""
    return getattr(command, "needs", Needs(EXTRAS.get(name, ()), name in CACHED))


def check_requirements(needs: Needs, values: Mapping[str, Any]) -> None:
    """Check what a command needs for the values of its parameters."""
    for name, value in values.items():
        for number in value if isinstance(value, (list, tuple)) else [value]:
            if isinstance(number, float) and not math.isfinite(number):
                raise UsageError(f"The option {name!r} takes a finite number; received {number}.")
    lacking = {
        DISTRIBUTIONS.get(module, module): requirement
        for requirement in needs.packages
        for module in (requirement.packages if requirement.when(values) else ())
        if find_spec(module) is None
    }
    if lacking:
        extras = ",".join(dict.fromkeys(item.extra for item in lacking.values()))
        raise missing_dependency(*lacking, extra=extras, purpose=next(iter(lacking.values())).purpose)
    if needs.cache:
        check_folder(cache_dir(), CACHE_VARIABLE)


def guard(app: typer.Typer) -> None:
    """Let every command check what it needs before it runs; once, however often its command line is built."""
    for name, command in commands(app):
        if command.callback is not None and not hasattr(command, "guarded"):
            command.guarded = True
            checked = _checked(name, command.callback)
            command.callback = printed(_linked(checked) if name in FOREIGN else checked)


def _linked(callback: Callable[..., Output]) -> Callable[..., Output]:
    """Return a command with the option ``--allow-linked``."""

    @functools.wraps(callback)
    def run(*, allow_linked: Any = None, **values: Any) -> Output:
        if allow_linked:
            os.environ[LINKED_VARIABLE] = os.pathsep.join(map(str, allow_linked))
        return callback(**values)

    help = "HDF5 files may link into this folder too, beside their own; give it again for more."
    option = typer.Option("--allow-linked", metavar="FOLDER", help=help, exists=True, file_okay=False)
    added = inspect.Parameter(
        "allow_linked", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[list[Path] | None, option]
    )
    signature = inspect.signature(callback, eval_str=True)
    parameters = [*(item.replace(kind=added.kind) for item in signature.parameters.values()), added]
    setattr(run, "__signature__", signature.replace(parameters=parameters))  # noqa: B010 - unknown to type checkers
    return run


def commands(app: typer.Typer, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the name of each command, those of its groups before it, and what typer knows of it."""
    for command in app.registered_commands:
        yield f"{path}{command.name}", command
    for group in app.registered_groups:
        if group.typer_instance is not None:
            yield from commands(group.typer_instance, f"{path}{group.name} ")


def _checked(name: str, callback: Callable[..., Any]) -> Callable[..., Any]:
    needed = needs_of(name, callback)

    @functools.wraps(callback)
    def run(*args: Any, **values: Any) -> Any:
        check_requirements(needed, values)
        return callback(*args, **values)

    return run
