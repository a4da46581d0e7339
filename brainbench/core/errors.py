"""Errors that tell the user what was received, what is allowed and what to do next; checks that raise them."""

from __future__ import annotations

import difflib
import math
import numbers
import re
import unicodedata
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

MOST_OF_A_MESSAGE = 400
"""Characters of the longest message: a longer one is cut in its middle, since its end says what to do."""
_CONTROL = (
    # C0 and C1; marks of direction and what has no width; ends of lines and paragraphs; tags; halves of pairs
    "[\\x00-\\x1f\\x7f-\\x9f\\u061c\\u200b-\\u200f\\u2028-\\u202e\\u2060-\\u206f\\ufeff\\ufff9-\\ufffb"
    "\\U000e0000-\\U000e007f\\ud800-\\udfff]"
)
_UNSAFE = re.compile(rf"{_CONTROL}|^\s+|\s+$|^\s*(?:::|##\[)")
_UNSAFE_IN_LINES = re.compile(rf"(?P<style>\x1b\[[\d;]{{0,16}}m)|(?![\n\t]){_CONTROL}")


class BrainbenchError(Exception):
    """Base of every error this toolkit raises on purpose; its text is one sentence for the user."""

    exit_code = 1
    """Exit status of the command line when this error ends it."""

    def __str__(self) -> str:
        """Return the message, of bounded length."""
        text = super().__str__()
        head, tail = MOST_OF_A_MESSAGE * 5 // 8, MOST_OF_A_MESSAGE * 3 // 8 - 3
        return text if len(text) <= MOST_OF_A_MESSAGE else f"{text[:head]} … {text[-tail:]}"


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


def visible(text: object) -> str:
    """Return a text of others as one line of data: it can neither steer what shows it nor begin a command there.

    Control characters, marks of direction, what has no width and blanks at the edges are written as escapes, and so is
    the beginning of a command of a workflow. The one filter for terminals, Markdown, HTML and names of files.

    >>> visible("x\\n::error::y"), visible("::error::y"), visible("s4-small ")
    ('x\\\\n::error::y', '\\\\x3a\\\\x3aerror::y', 's4-small\\\\x20')
    """
    return _UNSAFE.sub(lambda match: "".join(map(_escaped, match[0])), str(text))


def visible_lines(text: str, *, styled: bool = False) -> str:
    """Return a text of several lines without control characters; those of style stay where the terminal has some."""
    if text.isprintable():  # no control, mark of direction or end of line is
        return text
    return _UNSAFE_IN_LINES.sub(
        lambda match: match[0] if styled and match["style"] else "".join(map(_escaped, match[0])), text
    )


_TWINS = {
    ord(twin): plain
    for plain, twins in {
        "a": "аαɑᎪ", "b": "вβɓʙᏴ", "c": "сϲɕᏟ", "d": "ԁɖᎠ", "e": "еҽεᎬ", "f": "ϝ", "g": "ԍցɡᏀ", "h": "һհнʜᎻ",
        "i": "іїιɩıᎥ", "j": "јյȷᎫ", "k": "кκᏦ", "l": "ӏլʟᏞ1", "m": "мᎷ", "n": "пηոɴƞ", "o": "оοσօ0", "p": "рρᏢ",
        "q": "ԛգզ", "r": "гʀᏒ", "s": "ѕꜱᏚ", "t": "тτտƭᎢ", "u": "цυսʊμ", "v": "ѵνʋᏙ", "w": "ԝωᏔᎳ", "x": "хχ",
        "y": "уүγʏᎩ", "z": "ζᏃ", "3": "зӡ",
    }.items()
    for twin in twins
}  # fmt: skip
"""Letters of other alphabets, by number, and the plain one that each looks like."""
_ALIKE = frozenset({"GREEK", "CYRILLIC", "ARMENIAN", "CHEROKEE", "COPTIC", "LISU"})
"""Scripts with letters like Latin ones; in a name that has such too they are shown as escapes."""
_BLANK = "\u115f\u1160"  # letters without any ink


def visible_name(name: str) -> str:
    """Return a name such that two which differ look different: what looks like a plain character is an escape.

    >>> visible_name("s4\\u2010small"), visible_name("\\u0455ma11"), visible_name("s4-small")
    ('s4\\\\u2010small', '\\\\u0455ma11', 's4-small')
    """
    mixed = any(map(str.isalpha, filter(str.isascii, name)))
    return visible("".join(mark if _is_plain(mark, mixed=mixed) else _escaped(mark) for mark in name))


def look_alike(name: str) -> str:
    """Return what a name looks like: equal for names that a reader cannot tell apart.

    >>> look_alike("S4\\u2010\\u0455mall ") == look_alike("s4-small")
    True
    """
    folded = unicodedata.normalize("NFKD", unicodedata.normalize("NFKC", name).casefold())
    marks = ("-" if unicodedata.category(mark) == "Pd" or mark in "_\u2212" else mark for mark in folded)
    return "".join(
        mark for mark in marks if unicodedata.category(mark)[0] not in "ZCM" and mark not in _BLANK
    ).translate(_TWINS)


def _is_plain(mark: str, *, mixed: bool) -> bool:
    if mark.isascii():
        return True
    # The twins are compared in small letters; Cherokee ones fold to large ones.
    twin = any(ord(letter) in _TWINS for letter in (mark, mark.casefold()))
    twin |= mixed and unicodedata.name(mark, "").partition(" ")[0] in _ALIKE
    plain = unicodedata.normalize("NFKC", mark) == mark and unicodedata.category(mark)[0] not in "ZCPSM"
    return plain and not twin and mark not in _BLANK


def _escaped(mark: str) -> str:
    return f"\\x{ord(mark):02x}" if " " <= mark <= "~" else mark.encode("unicode_escape").decode()


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
    choices = list(options)
    if not isinstance(name, Hashable) or name not in choices:  # an array would compare its entries
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


def check_number(
    name: str,
    value: Any,
    *,
    least: float = -math.inf,
    most: float = math.inf,
    above: float = -math.inf,
    below: float = math.inf,
    whole: bool = False,
) -> None:
    """Raise a :class:`UsageError` unless ``value`` is a finite number within all bounds, and whole if asked for."""
    plain = type(value) is int or (type(value) is float and not whole)
    kind = plain or (issubclass(type(value), numbers.Integral if whole else numbers.Real) and type(value) is not bool)
    if kind and -math.inf < value < math.inf and least <= value <= most and above < value < below:
        return
    bounds = {"at least": least, "at most": most, "above": above, "below": below}
    words = " and ".join(f"{word} {bound:,}" for word, bound in bounds.items() if math.isfinite(bound))
    raise UsageError(
        f"{name} must be a {'whole' if whole else 'finite'} number{words and ', '}{words}; received {brief(value)}."
    )


def check_numbers(name: str, value: Any, count: int, **bounds: Any) -> None:
    """Raise a :class:`UsageError` unless ``value`` holds so many numbers that :func:`check_number` takes."""
    values = list(value) if isinstance(value, Iterable) else []
    if len(values) != count:
        raise UsageError(f"{name} holds {count} numbers; received {brief(value)}.")
    for number in values:
        check_number(name, number, **bounds)


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
