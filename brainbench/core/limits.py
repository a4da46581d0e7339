"""Limits of the fields of a dataclass, stated in its annotations and read wherever a value arrives.

Construction checks them (:func:`limited`), msgspec reads the same annotations where files are converted, and the
command line where options are made from the dataclass::

    @limited
    class Stepping:
        step: Annotated[float, Limit(above=0, most=5e-3, unit="s")] = 1e-4
        order: Literal["first", "second"] = "first"
        corner: tuple[float, float, float] = (0.0, 0.0, 0.0)

A plain type is a limit too: ``float`` takes finite numbers, ``int`` whole ones, ``bool`` truth values, ``str`` texts,
``Literal`` one of its names, a dataclass one of its own, a tuple so many values of these, a mapping names and such
values. What stands behind another type is left to the class.

Other values in words (``links=12``, ``goal.threshold=0.2``), those of a command, of a preset (``fast,links=12``) and of
a list of faults, are read as the annotation of their field says: :func:`with_changes`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache, wraps
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, dataclass_transform, get_args, get_origin, overload

import msgspec

from brainbench.core.errors import UsageError, brief, check_kind, check_name, check_number, check_once

Check = Callable[[str, Any], None]
T = TypeVar("T")


def Limit(
    *,
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    below: float | None = None,
    shortest: int | None = None,
    longest: int | None = None,
    unit: str = "",
    infinite: bool = False,
    rising: bool = False,
) -> msgspec.Meta:
    """Return what stands behind the type in ``Annotated[...]``.

    Args:
        least, most: smallest and largest number.
        above, below: numbers that are themselves too small and too large.
        shortest, longest: lengths of a tuple or a text.
        unit: unit of the number, for messages.
        infinite: True where infinity is a value too.
        rising: True for a range (low, high) that is in order.
    """
    numbers: dict[str, Any] = {"ge": least, "le": most, "gt": above, "lt": below}
    about = {"unit": unit, "infinite": infinite, "rising": rising}
    return msgspec.Meta(min_length=shortest, max_length=longest, extra=about, **numbers)


Count = Annotated[int, Limit(least=1)]
Seed = Annotated[int, Limit(least=0)]
Share = Annotated[float, Limit(least=0, most=1)]
Positive = Annotated[float, Limit(above=0)]
NotNegative = Annotated[float, Limit(least=0)]


@overload
def limited(cls: type[T]) -> type[T]: ...


@overload
def limited(
    *, of: str = ..., names: Mapping[str, str] | None = ..., unresolved: Sequence[str] = ..., frozen: bool = ...,
    eq: bool = ..., repr: bool = ..., kw_only: bool = ...,
) -> Callable[[type[T]], type[T]]: ...  # fmt: skip


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def limited(
    cls: type | None = None,
    *,
    of: str = "{}",
    names: Mapping[str, str] | None = None,
    unresolved: Sequence[str] = (),
    frozen: bool = True,
    **options: bool,
) -> Any:
    """Make a class a frozen dataclass that checks the limits of its fields when one is made.

    What its own ``__post_init__`` checks, relations between fields, comes after.

    Args:
        cls: the class.
        of: text with braces for the field's name in messages, for instance ``"{} of a whisker"``.
        names: field → what messages call it, where that is not its own name.
        unresolved: fields without limits whose annotation names types that are imported for type checkers alone.
        frozen: False for a class whose fields may be set.
        options: further options of :func:`dataclasses.dataclass`: ``eq``, ``repr`` and ``kw_only``.
    """

    def decorate(cls: type) -> type:
        """Give a class the checks of its fields' limits, ahead of its own."""
        if "__dataclass_fields__" in vars(cls):
            raise TypeError(f"@limited makes a dataclass itself; take @dataclass off {cls.__qualname__}.")
        relations = vars(cls).get("__post_init__", getattr(cls, "__post_init__", None))

        def __post_init__(self: Any, *values: Any) -> None:
            check_limits(self)
            if relations is not None:
                relations(self, *values)

        if relations is not None:
            __post_init__ = wraps(relations)(__post_init__)
        __post_init__.checks_limits = True  # type: ignore[attr-defined]
        cls.__post_init__ = __post_init__  # type: ignore[attr-defined]
        cls.__limits_of__ = of  # type: ignore[attr-defined]
        cls.__limit_names__ = {**getattr(cls, "__limit_names__", {}), **(names or {})}  # type: ignore[attr-defined]
        cls.__unresolved__ = (*getattr(cls, "__unresolved__", ()), *unresolved)  # type: ignore[attr-defined]
        return dataclass(frozen=frozen, **options)(cls)

    return decorate if cls is None else decorate(cls)


def check_limits(options: Any) -> None:
    """Raise a :class:`UsageError` for the first field of a dataclass whose value is outside its limits."""
    cls = type(options)
    for name, (label, check) in _checks(cls).items():
        check(label, getattr(options, name))


def limits_of(cls: type) -> dict[str, Any]:
    """Return the annotations, resolved, of the fields of a dataclass that limit what they hold.

    Raises:
        TypeError: an annotation cannot be resolved, so that nobody knows its limits.
    """
    loose = getattr(cls, "__unresolved__", ())
    kinds = {field.name: annotation_of(cls, field.name) for field in fields(cls) if field.name not in loose}
    return {name: kind for name, kind in kinds.items() if checker(kind) is not None}


def annotation_of(cls: type, name: str) -> Any:
    """Return the annotation of a field as an object.

    Raises:
        TypeError: it cannot be resolved.
    """
    owner = next(base for base in cls.__mro__ if name in vars(base).get("__annotations__", {}))
    annotation = owner.__annotations__[name]
    if not isinstance(annotation, str):
        return annotation
    try:
        return eval(annotation, vars(sys.modules[owner.__module__]), dict(vars(owner)))
    except Exception as error:
        raise TypeError(
            f"The limits of {cls.__module__}.{cls.__qualname__}.{name} are unknown, since its annotation "
            f"{annotation!r} cannot be resolved: {error}. Import what it names at run time, or, if it has no limits, "
            f"name the field in @limited(unresolved=…)."
        ) from error


def check_value(name: str, value: Any, annotation: Any) -> None:
    """Raise a :class:`UsageError` that calls a value ``name`` unless its annotation allows it."""
    check = checker(annotation)
    if check is not None:
        check(name, value)


def bounds_of(annotation: Any) -> str:
    """Return the bounds of a number, or of the numbers of a tuple, in words: ``at least 1``; empty without any."""
    for kind in (annotation, *get_args(annotation)):
        for meta in getattr(kind, "__metadata__", ()):
            if isinstance(meta, msgspec.Meta):
                words = {"at least": meta.ge, "above": meta.gt, "at most": meta.le, "below": meta.lt}
                return ", ".join(f"{word} {bound:g}" for word, bound in words.items() if bound is not None)
    return ""


@cache
def _checks(cls: type) -> dict[str, tuple[str, Check]]:
    """Return, by field, its name in messages and its check."""
    of, names = getattr(cls, "__limits_of__", "{}"), getattr(cls, "__limit_names__", {})
    # No format: what a user named may hold braces of its own.
    checks = {name: (of.replace("{}", names.get(name, name)), checker(kind)) for name, kind in limits_of(cls).items()}
    return {name: (told, check) for name, (told, check) in checks.items() if check is not None}


def checker(annotation: Any, limit: msgspec.Meta | None = None) -> Check | None:
    """Return a function of a name and a value that raises :class:`UsageError`; None where nothing is limited.

    Raises:
        TypeError: limits stand where nothing reads them.
    """
    origin, kinds = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        metas = [meta for meta in annotation.__metadata__ if isinstance(meta, msgspec.Meta)]
        return checker(annotation.__origin__, metas[0] if metas else limit)
    if annotation is int or annotation is float:
        return _number(annotation is int, limit or Limit())
    sized = limit is not None and limit.ge is limit.gt is limit.le is limit.lt is None
    if origin in (tuple, list, Sequence) and (limit is None or sized):
        return _values(origin is tuple and kinds[-1:] != (Ellipsis,), kinds, limit or Limit())
    if annotation is str:
        return lambda name, value: _check_text(name, value, limit or Limit())
    if origin is Mapping and limit is None:
        return _mapping(checker(kinds[-1]))
    if limit is not None:
        raise TypeError(f"Limits stand behind a number, a text or a tuple, not behind {annotation}: {limit}.")
    if annotation is bool:
        return _check_truth
    if origin is Literal:
        return lambda name, value: check_name(name, value, kinds)
    if isinstance(annotation, type) and is_dataclass(annotation):
        return lambda name, value: check_kind(name, value, annotation, f"{annotation.__name__}(…)")
    return _union(kinds) if origin in (Union, UnionType) else None


def _number(whole: bool, limit: msgspec.Meta) -> Check:
    about = limit.extra or {"unit": "", "infinite": False}
    pairs = {"least": limit.ge, "most": limit.le, "above": limit.gt, "below": limit.lt}
    bounds = {word: bound for word, bound in pairs.items() if bound is not None}
    endless = [
        sign * math.inf
        for sign, words in ((1, ("most", "below")), (-1, ("least", "above")))
        if about["infinite"] and not {*words} & {*bounds}
    ]

    def check(name: str, value: Any) -> None:
        """Raise :class:`UsageError` unless a value is a number within the bounds, or infinite where that is allowed."""
        if not (endless and isinstance(value, float) and value in endless):
            check_number(f"{name} ({about['unit']})" if about["unit"] else name, value, whole=whole, **bounds)

    return check


def _check_truth(name: str, value: Any) -> None:
    if type(value).__name__ not in ("bool", "bool_"):  # NumPy has its own
        raise UsageError(f"{name} must be True or False; received {brief(value)}.")


def _union(kinds: Sequence[Any]) -> Check | None:
    checks = [(kind, checker(kind)) for kind in kinds if kind is not NoneType]
    if all(check is None for _, check in checks):
        return None
    allows_none = NoneType in kinds
    parts = tuple(kind for kind in kinds if isinstance(kind, type) and is_dataclass(kind))

    def check(name: str, value: Any) -> None:
        """Raise :class:`UsageError` unless one of the kinds allows a value."""
        faults = []
        for kind, limit in checks if value is not None or not allows_none else ():
            plain = get_origin(kind) or kind
            if (limit is None or kind in parts) and isinstance(plain, type) and not isinstance(value, plain):
                continue
            try:
                if limit is not None:
                    limit(name, value)
                return
            except UsageError as error:
                faults.append(error)
        if faults:
            # Of a number or a tuple, a tuple is answered as one.
            raise faults[-1 if isinstance(value, tuple | list) else 0]
        if parts and not (allows_none and value is None):
            check_kind(name, value, parts, " or ".join(f"{part.__name__}(…)" for part in parts))

    return check


def _values(fixed: bool, kinds: Sequence[Any], limit: msgspec.Meta) -> Check | None:
    checks = [checker(kind) for kind in kinds if kind is not Ellipsis]
    if all(check is None for check in checks) and not fixed and limit.min_length is limit.max_length is None:
        return None
    noun = "numbers" if {arm for kind in kinds for arm in _arms(kind)} <= {int, float, NoneType, Ellipsis} else "values"

    def check(name: str, value: Any) -> None:
        """Raise :class:`UsageError` unless a value is a row whose length and values are allowed."""
        no_row = str | bytes | Mapping | set | frozenset | Iterator
        several = isinstance(value, Iterable) and not isinstance(value, no_row) and getattr(value, "ndim", 1) > 0
        values: list[Any] = list(value) if several else []
        if not several or (fixed and len(values) != len(checks)):
            raise UsageError(f"{name} holds {f'{len(checks)} {noun}' if fixed else noun}; received {brief(value)}.")
        _check_length(name, values, limit, "values")
        for inner, limited in zip(values, checks if fixed else checks * len(values), strict=True):
            if limited is not None:
                limited(name, inner)
        if (limit.extra or {}).get("rising") and values[0] > values[-1]:
            raise UsageError(f"{name} is a range (low, high); received {brief(value)}.")

    return check


def _mapping(limited: Check | None) -> Check:
    check_inner: Check = limited or (lambda name, value: None)

    def check(name: str, value: Any) -> None:
        """Raise :class:`UsageError` unless a value is a mapping whose values are allowed."""
        check_kind(name, value, Mapping, "names and values")
        for key, inner in value.items():
            check_inner(f"{name} ({brief(key, quoted=False)})", inner)

    return check


def _check_text(name: str, value: Any, limit: msgspec.Meta) -> None:
    check_kind(name, value, str, "a text")
    _check_length(name, value, limit, "characters")


def _check_length(name: str, value: Any, limit: msgspec.Meta, noun: str) -> None:
    shortest, longest = limit.min_length or 0, limit.max_length or math.inf
    if not shortest <= len(value) <= longest:
        words = [f"at least {shortest:,}"] * (shortest > 0) + [f"at most {longest:,}"] * (longest < math.inf)
        raise UsageError(f"{name} holds {' and '.join(words)} {noun}; received {brief(value)}.")


def read_pairs(words: Iterable[str], where: str, example: str) -> dict[str, str]:
    """Return name → text of words ``name=text``; ``where`` names the option or text that they stand in.

    >>> read_pairs(["links=12", "solver = dynamic"], "--change", "links=12")
    {'links': '12', 'solver': 'dynamic'}
    """
    pairs = []
    for word in words:
        name, sign, text = (part.strip() for part in word.partition("="))
        if not (name and sign):
            raise UsageError(f"{where} takes name=value, such as {example}; received {brief(word)}.")
        pairs.append((name, text))
    check_once(where, [name for name, _ in pairs])
    return dict(pairs)


def with_changes(options: T, changes: Mapping[str, str]) -> T:
    """Return a frozen dataclass with other values; a name reaches fields of its parts by dots."""
    for name, text in changes.items():
        options = _changed(options, name.split("."), text)
    return options


def read_value(name: str, text: str, annotation: Any, present: Any = None) -> Any:
    """Return the value that a text states for an annotation; ``present`` is the value in its place, for messages."""
    kinds = [kind for kind in _arms(annotation) if kind is not NoneType]
    if text == "none" and len(kinds) < len(_arms(annotation)):
        return None
    readable = [kind for kind in kinds if kind in _READ or get_origin(kind) in (Literal, tuple)]
    if not readable:
        raise UsageError(f"{name!r} is more than a number; change it in Python, with dataclasses.replace.")
    for kind in readable:
        try:
            value = _read(text, kind)
            if get_origin(kind) is not Literal:  # the class itself names the nearest choice
                check_value(name, value, kind)
            return value
        except (KeyError, ValueError, OverflowError):
            continue
    words = " or ".join(_words(kind) for kind in readable)
    now = "" if present is None else f", for instance {brief(present)}"
    raise UsageError(f"{name!r} takes {words}{now}; received {brief(text)}.")


def kind_of(value: Any) -> Any:
    """Return the annotation of what may stand in place of a value that has none of its own."""
    if isinstance(value, tuple) and all(isinstance(inner, int | float) for inner in value):
        return tuple[int, ...] if value and all(isinstance(inner, int) for inner in value) else tuple[float, ...]
    return float if value is None else type(value)


def _changed(options: Any, path: list[str], text: str) -> Any:
    first, *rest = path
    check_name(f"field of {type(options).__name__}", first, [field.name for field in fields(options)])
    present = getattr(options, first)
    if not rest:
        return replace(options, **{first: read_value(first, text, annotation_of(type(options), first), present)})
    if not is_dataclass(present):
        raise UsageError(f"{first!r} has no parts; received {brief('.'.join(path))}.")
    return replace(options, **{first: _changed(present, rest, text)})


def _arms(annotation: Any) -> list[Any]:
    """Return the kinds that an annotation allows, without what is said of them."""
    if get_origin(annotation) is Annotated:
        return _arms(annotation.__origin__)
    if get_origin(annotation) in (Union, UnionType):
        return [arm for kind in get_args(annotation) for arm in _arms(kind)]
    return [annotation]


def _read(text: str, kind: Any) -> Any:
    if get_origin(kind) is Literal:
        return text
    if get_origin(kind) is tuple:
        (inner,) = _arms(get_args(kind)[0])
        return tuple(_READ[inner][0](part.strip()) for part in text.split(","))
    return _READ[kind][0](text)


def _words(kind: Any) -> str:
    if get_origin(kind) is tuple:
        return "numbers joined by commas"
    return _READ[kind][1]


def _whole(text: str) -> int:
    number = float(text)
    if number != int(number):
        raise ValueError
    return int(number)


_READ: dict[Any, tuple[Any, str]] = {
    str: (str, "a text"),
    bool: (lambda text: {"true": True, "false": False}[text.lower()], "true or false"),
    int: (_whole, "a whole number"),
    float: (float, "a number"),
}
"""Kind → its reader, and its name in messages."""
