"""Errors that tell the user what was received, what is allowed and what to do next."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any


class BrainbenchError(Exception):
    """Base of every error this toolkit raises on purpose; its text is one sentence for the user."""

    exit_code = 1
    """Exit status of the command line when this error ends it."""


class UsageError(BrainbenchError, ValueError):
    """The request itself is wrong: an unknown name, a bad option, shapes that do not fit."""

    exit_code = 2


class DataError(BrainbenchError, ValueError):
    """A file or an array was found but its content cannot be used."""


class DataFileNotFoundError(DataError, FileNotFoundError):
    """A path that was asked for does not exist or matches nothing."""

    exit_code = 2


class FileWriteError(DataError, OSError):
    """A file or a folder cannot be written: no permission, no space, or a file where a folder is needed."""


class MissingDependencyError(BrainbenchError, ImportError):
    """An optional package is needed for what was asked."""


def brief(value: object, *, quoted: bool = True, most: int = 80) -> str:
    """Return a value for a message, cut after ``most`` characters; the end of a path is what tells it apart.

    >>> brief("a" * 100, most=10)
    "'aaaaaaaaaa…'"
    """
    if getattr(value, "ndim", None) == 0:
        value = value.item()  # type: ignore[attr-defined] # of NumPy, whose repr names its type
    if not isinstance(value, str):
        value = type(value).__name__ if isinstance(value, int) and value.bit_length() > 999 else repr(value)
        quoted = False
    if len(value) > most and "/" in value[-most:] and "\n" not in value:
        value = value if len(value) <= 4 * most else f"…{value[-most:]}"
    elif len(value) > most:
        value = f"{value[:most]}…"
    return repr(value) if quoted else value


def nearest(name: str, options: Iterable[str]) -> str | None:
    """Return the option closest in spelling to ``name``, or None when nothing is close.

    Of dotted options the last part counts too.

    >>> nearest("zhuan", ["zhuang", "resnet18"])
    'zhuang'
    >>> nearest("fc7", ["encoder.conv1", "encoder.fc7"])
    'encoder.fc7'
    """
    choices = list(options)
    lowered = {choice.lower(): choice for choice in reversed(choices)}
    last_parts = {choice.lower().rpartition(".")[2]: choice for choice in reversed(choices)}
    for candidates in (lowered, last_parts):
        if hits := difflib.get_close_matches(name.lower(), candidates, n=1, cutoff=0.5):
            return candidates[hits[0]]
    return None


def listing(options: Iterable[str], *, limit: int = 12, quoted: bool = True) -> str:
    """Join options for a message and say how many were left out; unquoted ones are shown whole.

    >>> listing(["a", "b", "c"], limit=2)
    "'a', 'b' and 1 more"
    """
    choices = list(options)
    text = ", ".join(brief(choice) if quoted else choice for choice in choices[:limit])
    if len(choices) > limit:
        text += f" and {len(choices) - limit} more"
    return text if choices else "none"


def unknown_name(kind: str, name: object, options: Iterable[str], *, hint: str = "") -> UsageError:
    """Build the error for a name that is not among ``options``, with the nearest valid one.

    >>> str(unknown_name("backend", "mujocco", ["mujoco", "bullet"]))
    "Unknown backend 'mujocco'; did you mean 'mujoco'? Allowed: 'mujoco', 'bullet'."
    """
    choices = [str(option) for option in options]
    guess = nearest(name, choices) if isinstance(name, str) and len(name) < 200 else None
    suggestion = f"; did you mean {brief(guess)}?" if guess else "."
    text = f"Unknown {kind} {brief(name)}{suggestion} Allowed: {listing(choices)}."
    return UsageError(f"{text} {hint}".rstrip())


def check_name(kind: str, name: object, options: Iterable[str], *, hint: str = "") -> None:
    """Raise the error of :func:`unknown_name` unless a name is among the options."""
    if name not in (choices := list(options)):
        raise unknown_name(kind, name, choices, hint=hint)


def check_each(kind: str, names: Iterable[object], options: Iterable[str]) -> None:
    """Raise the error of :func:`unknown_name` for the first name that is not among the options."""
    choices = list(options)
    for name in names:
        check_name(kind, name, choices)


def repeats(names: Iterable[Hashable]) -> list[Any]:
    """Return what occurs more than once, in order of appearance.

    >>> repeats(["b", "a", "b", "a", "c"])
    ['b', 'a']
    """
    return [name for name, count in Counter(names).items() if count > 1]


def check_kind(name: str, value: object, kind: type | tuple[type, ...], wanted: str) -> None:
    """Raise a :class:`UsageError` unless a value is of a kind, of which ``wanted`` is an example."""
    if not isinstance(value, kind):
        raise UsageError(f"The {name} must be {wanted}; received {brief(value)} ({type(value).__name__}).")


def check_once(where: str, names: Iterable[str]) -> None:
    """Raise a :class:`UsageError` if a name stands more than once.

    >>> check_once("--known", ["density", "density"])
    Traceback (most recent call last):
    brainbench.core.errors.UsageError: --known names 'density' more than once; only one would count.
    """
    if twice := repeats(names):
        raise UsageError(f"{where} names {listing(twice, limit=4)} more than once; only one would count.")


def choose_name(kind: str, wanted: str | None, options: Iterable[str], *, how: str = "") -> str:
    """Return the name that is wanted, or the only one there is; ``how`` says in what way one is named.

    >>> choose_name("stimulus", None, ["pole"])
    'pole'
    """
    choices = list(options)
    if wanted is None and len(choices) != 1:
        raise UsageError(f"Name one {kind}{how and ' ' + how}; there are {listing(choices)}.")
    chosen = choices[0] if wanted is None else wanted
    check_name(kind, chosen, choices)
    return chosen


def install_command(extra: str) -> str:
    """Return the command that installs an extra, to be given where this package was checked out.

    >>> install_command("report")
    "pip install -c constraints.txt '.[report]'"
    """
    return f"pip install -c constraints.txt '.[{extra}]'"


def missing_dependency(*packages: str, extra: str, purpose: str) -> MissingDependencyError:
    """Build the error for optional packages, naming the extra, or extras with commas between, that installs them."""
    names = ", ".join(map(repr, packages))
    words = ("packages", "are", "them") if len(packages) > 1 else ("package", "is", "it")
    return MissingDependencyError(
        f"{purpose} needs the {words[0]} {names}, which {words[1]} not installed; "
        f"install {words[2]}, in the checkout of brainbench, with: {install_command(extra)}"
    )


@contextmanager
def needing(package: str, *, extra: str, purpose: str) -> Iterator[None]:
    """Make the error of :func:`missing_dependency` from an import that fails within."""
    try:
        yield
    except ImportError as error:
        raise missing_dependency(package, extra=extra, purpose=purpose) from error
