"""Options of the commands, made from the dataclasses that state them.

A command decorated with :func:`with_options` takes one parameter ``options`` and has, in its place, one flag per field
of a dataclass: the name, kind and default of the field, and its docstring as the help. The source of the dataclass is
parsed, not imported, so that ``--help`` stays quick whatever its package loads.

Outputs of a command (``--out``, pictures, reports) are checked when the command line is read: before anything slow. So
are its requirements: packages of extras, a cache that can be written, and numbers that are numbers (:func:`needs`).
"""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import os
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer

from brainbench.cli.output import Output, show
from brainbench.core import limits
from brainbench.core.errors import UsageError, brief, check_name, missing_dependency
from brainbench.core.figures import check_format
from brainbench.core.files import cache_dir, check_folder
from brainbench.core.limits import bounds_of, check_value
from brainbench.core.reading.hdf5 import LINKED_VARIABLE

WorkersOption = Annotated[
    int | None, typer.Option(min=1, help="Processes. \\[default: as many as there are processors]")
]
SeedOption = Annotated[int, typer.Option(help="Seed of untrained weights.")]
PlanOption = Annotated[Path | None, typer.Option(help="Seal the design in this JSON file, for 'score --plan'.")]
SchedulerOption = Annotated[str | None, typer.Option(help="Let workers of a Dask scheduler (tcp://host:8786) do it.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout, nothing else.")]
LinkedOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--allow-linked",
        metavar="FOLDER",
        help="HDF5 files may link into this folder too, beside their own; give it again for more.",
        exists=True,
        file_okay=False,
    ),
]

SCORE = "brainbench.scoring.options:ScoreOptions"
SCORE_FLAGS = {
    "recordings": ("--recordings", "-r"),
    "stimuli": ("--stimuli", "-s"),
    "explain": ("--explain-estimator",),
}
"""Flags of fields of :class:`~brainbench.scoring.ScoreOptions` that are not just their names."""

_KINDS = (str, int, float, bool, Path)
_NAMES: dict[str, Any] = {**vars(builtins), "Path": Path, "Annotated": Annotated, "Literal": Literal, "math": math}
"""Names in annotations that are what they always are."""


@dataclass(frozen=True)
class OptionField:
    """One field of a dataclass as an option."""

    annotation: Any
    """Its annotation, in which types that the command line does not know are all one."""
    default: Any
    help: str

    @property
    def several(self) -> bool:
        """Whether the field holds a tuple, which is written with commas on the command line."""
        return get_origin(_bare(self.annotation)) is tuple

    @property
    def kind(self) -> Any:
        """Type of one value."""
        return next((kind for kind in _plain_types(self.annotation) if kind in _KINDS), str)

    def parameter(self, name: str, flags: tuple[str, ...], default: Any) -> inspect.Parameter:
        """Return the parameter of a typer command."""
        # A switch that is off by default has no opposite.
        flags = flags or ((f"--{name.replace('_', '-')}",) if self.kind is bool and not default else ())
        kind = str if self.several else self.kind
        bounds = bounds_of(_bare(self.annotation, bounds=True))
        text = f"{self.help} \\[{bounds}]" if bounds else self.help
        hint = Annotated[kind if default is not None else kind | None, typer.Option(*flags, help=text)]
        return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hint)

    def value(self, name: str, given: Any) -> Any:
        """Return what the field of a name holds for a value of the command line, within its limits."""
        if given is None:
            return None
        if self.several:
            given = tuple(items(given)) if self.kind is str else numbers(given, f"--{name}", self.kind)
        check_value(f"--{name.replace('_', '-')}", given, self.annotation)
        return given


def _plain_types(annotation: Any) -> Iterator[Any]:
    """Yield the types that an annotation is composed of."""
    inner = [] if get_origin(annotation) is Literal else get_args(annotation)
    for kind in inner[:1] if get_origin(annotation) is Annotated else inner:
        yield from _plain_types(kind)
    if not inner:
        yield annotation


def _bare(annotation: Any, *, bounds: bool = False) -> Any:
    """Return an annotation without ``None``, and without what is said of it unless its ``bounds`` are wanted."""
    if get_origin(annotation) in (Union, UnionType):
        annotation = next((kind for kind in get_args(annotation) if kind is not NoneType), _Unknown)
    return annotation.__origin__ if get_origin(annotation) is Annotated and not bounds else annotation


class _AnyType(type):
    """Metaclass of the type that stands for all that are not known: its attributes and items are itself."""

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return cls

    def __getitem__(cls, _: Any) -> Any:
        return cls

    def __instancecheck__(cls, _: Any) -> bool:
        return True


class _Unknown(metaclass=_AnyType):
    """A type that the command line reads as text."""


class _SourceNames(dict[str, Any]):
    """Names that annotations of a module use, as far as its source states them: constants and limits."""

    def __init__(self, module: str) -> None:
        self._constants = {}
        for node in _tree(module).body:
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                self._constants[node.targets[0].id] = node.value
            elif isinstance(node, ast.ImportFrom):
                self._constants |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
        super().__init__(_NAMES)

    def __missing__(self, name: str) -> Any:
        stated = self._constants.get(name)
        if isinstance(stated, tuple):
            module, inner = stated
            if module == limits.__name__:
                return getattr(limits, inner)
            # Constants and annotations with a name of their own are read where they are assigned; classes stay unknown.
            ours = module.partition(".")[0] in ("brainbench", "robotics_bridge")
            return _SourceNames(module)[inner] if ours else _Unknown
        return _Unknown if stated is None else self.evaluated(stated)

    def evaluated(self, node: ast.expr) -> Any:
        """Return the value of an expression of the module."""
        return eval(compile(ast.Expression(node), "<annotation>", "eval"), {"__builtins__": {}}, self)


@cache
def _tree(module: str) -> ast.Module:
    package, *parts = module.split(".")
    origin = getattr(find_spec(package), "origin", None)
    assert origin is not None, module
    return ast.parse(Path(origin).parent.joinpath(*parts).with_suffix(".py").read_text(encoding="utf-8"))


@cache
def option_fields(kind: str) -> Mapping[str, OptionField]:
    """Return the fields of the dataclass ``package.module:Class`` by name, from its source."""
    module, _, wanted = kind.partition(":")
    (body,) = (node.body for node in _tree(module).body if isinstance(node, ast.ClassDef) and node.name == wanted)
    names, options = _SourceNames(module), {}
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        said = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
        options[node.target.id] = OptionField(
            annotation=names.evaluated(node.annotation),
            default=_plain_default(node.value, names),
            help=_plain(str(said)),
        )
    return options


def _plain_default(node: ast.expr | None, names: _SourceNames) -> Any:
    """Return a default that the command line can show; None for those that only the class itself can make."""
    if not isinstance(node, ast.Constant | ast.Name | ast.Call):
        return None
    if isinstance(node, ast.Call) and ast.unparse(node.func) != "Path":
        return None
    default = names.evaluated(node)
    return default if isinstance(default, _KINDS) else None


def with_options(
    kind: str,
    names: Iterable[str] | None = None,
    *,
    parameter: str = "options",
    flags: Mapping[str, tuple[str, ...]] | None = None,
    defaults: Mapping[str, Any] | None = None,
    build: bool = True,
    given: bool = False,
    help: str | None = None,
) -> Callable[[Callable[..., Output]], Callable[..., Output]]:
    """Decorate a command so that one parameter of it is filled from flags.

    Args:
        kind: The dataclass, ``package.module:Class``.
        names: Fields that have a flag; all of them by default.
        parameter: The parameter of the command.
        flags: Flags of a field, where they are not its name with hyphens.
        defaults: Defaults of this command, where they are not those of the dataclass.
        build: Hand over the dataclass; else a mapping of its fields.
        given: Hand over a mapping of the values that were given; no flag has a default then.
        help: One help for all of them, in place of their docstrings.
    """
    stated = option_fields(kind)
    module, _, wanted = kind.partition(":")
    parameters, fields_of = [], {}
    for name in stated if names is None else names:
        field, default = stated[name], None if given else (defaults or {}).get(name, stated[name].default)
        if help is not None:
            field = replace(field, help=help)
        words = (flags or {}).get(name, ())
        # Called by its flag, an option does not clash with a field of this name of another dataclass.
        variable = words[0].removeprefix("--").replace("-", "_") if words else name
        fields_of[variable] = name
        parameters.append(field.parameter(variable, words, default))

    def make(values: dict[str, Any]) -> Any:
        """Return the dataclass, or the mapping, of the values of its flags."""
        options = {fields_of[flag]: stated[fields_of[flag]].value(flag, value) for flag, value in values.items()}
        # Defaults that are tuples are not read from the source; the dataclass has them.
        options = {n: value for n, value in options.items() if not (stated[n].several and value is None)}
        if given:
            options = {name: value for name, value in options.items() if value is not None}
        return getattr(import_module(module), wanted)(**options) if build and not given else options

    # The dataclass is named in the signature of a command and not imported.
    return lambda command: filled_from(command, parameter, parameters, make, **{wanted: Any})


def filled_from(
    command: Callable[..., Output],
    parameter: str,
    options: Sequence[inspect.Parameter],
    make: Callable[[dict[str, Any]], Any],
    **unloaded: Any,
) -> Callable[..., Output]:
    """Return a command that has options in place of one parameter, which ``make`` makes of their values.

    ``unloaded`` stand for names of its annotations that are not imported.
    """
    parameters = inspect.signature(command, locals=unloaded, eval_str=True).parameters.values()
    every = [item for one in parameters for item in (options if one.name == parameter else [one])]

    def run(**values: Any) -> Output:
        """Run the command with its one parameter made of the values of the options."""
        filled = make({item.name: values.pop(item.name) for item in options})
        return command(**{parameter: filled}, **values)

    return _as_command(run, command, every)


def _as_command(run: Callable[..., Any], command: Callable[..., Any], every: Iterable[inspect.Parameter]) -> Any:
    """Return a function with the parameters that typer reads, under the name and the docstring of a command."""
    parameters = [item.replace(kind=inspect.Parameter.KEYWORD_ONLY) for item in every]
    run.__doc__, run.__name__ = command.__doc__, command.__name__
    run.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    run.__annotations__ = {item.name: item.annotation for item in parameters}
    return run


def typed_options(words: Iterable[str]) -> list[str]:
    """Return the fields of a score's options for which a flag stands among the words of a command line."""
    flags, plain = (
        {word.partition("=")[0] for word in words},
        {name: name.replace("_", "-") for name in option_fields(SCORE)},
    )
    return [name for name, flag in plain.items() if flags & {f"--{flag}", f"--no-{flag}", *SCORE_FLAGS.get(name, ())}]


def option(kind: str, name: str, *flags: str) -> Any:
    """Return typer's description of an option whose help is that of a field of a dataclass."""
    return typer.Option(*flags, help=option_fields(kind)[name].help)


def as_flags(kind: str, options: Any, flags: Mapping[str, tuple[str, ...]]) -> list[str]:
    """Return the words of a command line that give a dataclass: the fields that differ from their defaults."""
    words: list[str] = []
    for field in fields(options):
        value, stated = getattr(options, field.name), option_fields(kind)[field.name]
        if value == field.default:
            continue
        flag = flags.get(field.name, (f"--{field.name.replace('_', '-')}",))[0]
        if stated.kind is bool:
            words.append(flag if value else f"--no-{flag.removeprefix('--')}")
        else:
            words += [flag, ",".join(map(str, value)) if stated.several else str(value)]
    return words


def score_command(model: str, options: Any) -> str:
    """Return the command line that makes a score by itself."""
    return shlex.join(["brainbench", "score", model, *as_flags(SCORE, options, SCORE_FLAGS)])


def changed(kind: str, values: Mapping[str, Any]) -> dict[str, bool]:
    """Return by flag which values differ from the defaults of their fields, for :func:`refuse`."""
    stated = option_fields(kind)
    return {f"--{name.replace('_', '-')}": value != stated[name].default for name, value in values.items()}


def refuse(options: Mapping[str, object], where: str) -> None:
    """Raise a :class:`UsageError` for options, by flag, that were given and would mean nothing ``where`` they are."""
    if given := [flag for flag, value in options.items() if not (value is None or value is False or value == "")]:
        raise UsageError(f"{' and '.join(given)} cannot be used {where}; leave it out.")


def items(text: str) -> list[str]:
    """Return the texts between commas."""
    return [item.strip() for item in text.split(",") if item.strip()]


def numbers(text: str, what: str, kind: Callable[[str], Any] = int, *, count: int | None = None) -> tuple[Any, ...]:
    """Return numbers written with commas (or, where there is a ``count`` of them, with x or ×) between them."""
    fault = None
    try:
        values = tuple(kind(item) for item in (items(text) if count is None else re.split(r"[,x×]", text)))
    except ValueError as error:
        values, fault = (), error
    if fault is not None or count not in (None, len(values)) or not all(map(math.isfinite, values)):
        of = f"{count} numbers" if count is not None else "whole numbers" if kind is int else "numbers"
        raise UsageError(f"{what} takes {of} joined by commas; received {brief(text)}.") from fault
    return values


def part_of(text: str, what: str) -> tuple[int, int]:
    """Return the number and the count of ``NUMBER/COUNT``, the number from 0."""
    number, _, count = text.partition("/")
    if not re.fullmatch(r"\d{1,9}/\d{1,9}", text) or int(number) >= int(count):
        raise UsageError(f"{what} NUMBER/COUNT, the number from 0, such as 0/4; received {brief(text)}.")
    return int(number), int(count)


def _plain(text: str) -> str:
    """Return a docstring without its markup; a unit in brackets is none of the terminal's."""
    text = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", text).replace("``", "")
    return re.sub(r"\[(?=[a-z#/@])", r"\\[", " ".join(text.split()))


def out_folder(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Return the folder of an option if files can be written into it; else a :class:`UsageError`."""
    if path is not None:
        check_folder(path, option.opts[0])
    return path


def out_file(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Return the file of an option if it can be written; else a :class:`UsageError`."""
    return None if path is None else _file(path, option.opts[0])


def out_folder_option(help: str) -> Any:
    """Return the option ``--out`` of a command that writes a folder."""
    return typer.Option("--out", "-o", callback=out_folder, help=help)


def out_file_option(help: str) -> Any:
    """Return the option ``--out`` of a command that writes a file."""
    return typer.Option("--out", "-o", callback=out_file, help=help)


def picture_file(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Return the picture of an option if it can be drawn and written; else a :class:`UsageError`."""
    if path is not None:
        check_format(path, (".png", ".svg", ".pdf"))
    return out_file(option, path)


def beside(option: typer.CallbackParam, path: Path) -> Path:
    """Return a file or folder if something of this name can be written; else a :class:`UsageError`."""
    check_folder(path.parent, option.opts[0])
    return path


def report_file(path: Path | None) -> Path | None:
    """Return the file of ``--report`` if it can be written and its ending is that of a format which can be made."""
    if path is None:
        return None
    from leaderboards.report.paper import FORMATS

    kind = path.suffix.removeprefix(".").lower()
    check_name("report format", kind or path.name, FORMATS, hint="The ending of --report chooses it.")
    if kind == "pdf" and find_spec("weasyprint") is None:
        raise missing_dependency("weasyprint", extra="board", purpose="A report as PDF")
    return _file(path, "--report")


def _file(path: Path, option: str) -> Path:
    if path.is_dir():
        raise UsageError(f"{option} names {brief(str(path))}, which is a folder; name a file in it.")
    check_folder(path.parent, option)
    return path


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
    "tactile demo", "policy play", "policy train", "policy evaluate", "policy distill",
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
        """Note at a command what it needs."""
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
        cache_dir()


def guard(app: typer.Typer) -> None:
    """Let every command check what it needs, and print what it returns; once, however often its line is built."""
    for name, command in commands(app):
        if command.callback is not None and not hasattr(command, "guarded"):
            command.guarded = True
            command.callback = _guarded(name, command.callback)


def _guarded(name: str, command: Callable[..., Output]) -> Callable[..., None]:
    """Return a command with the options ``--json`` and, where it reads files of others, ``--allow-linked``."""
    needed = needs_of(name, command)
    added = [("allow_linked", LinkedOption, None)] * (name in FOREIGN) + [("as_json", JsonOption, False)]

    def run(*, as_json: bool, allow_linked: Sequence[Path] | None = None, **values: Any) -> None:
        """Run the command if what it needs is there, and print what it returns."""
        check_requirements(needed, values)
        if allow_linked:
            os.environ[LINKED_VARIABLE] = os.pathsep.join(map(str, allow_linked))
        show(command(**values), as_json=as_json)

    parameters = inspect.signature(command, eval_str=True).parameters.values()
    kind = inspect.Parameter.KEYWORD_ONLY
    more = (inspect.Parameter(key, kind, default=default, annotation=hint) for key, hint, default in added)
    guarded = _as_command(run, command, (*parameters, *more))
    guarded.needs = needed
    return guarded


def commands(app: typer.Typer, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the name of each command, those of its groups before it, and what typer knows of it."""
    for command in app.registered_commands:
        yield f"{path}{command.name}", command
    for group in app.registered_groups:
        if group.typer_instance is not None:
            yield from commands(group.typer_instance, f"{path}{group.name} ")
