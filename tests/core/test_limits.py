"""Limits of fields: one table over every class of options, and what the annotations themselves can say."""

from __future__ import annotations

import contextlib
import copy
import importlib
import inspect
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, FrozenInstanceError, dataclass, field, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.limits import (
    Count,
    Limit,
    NotNegative,
    bounds_of,
    check_limits,
    check_value,
    kind_of,
    limited,
    limits_of,
    read_pairs,
    read_value,
    with_changes,
)

ROOT = Path(__file__).parents[2]


MODULES = [
    ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
    for package in ("brainbench", "robotics_bridge", "leaderboards")
    for path in sorted((ROOT / package).rglob("*.py"))
    if re.search(r"^ *@limited", path.read_text(encoding="utf-8"), re.M)
    for parts in [path.relative_to(ROOT).with_suffix("").parts]
]
"""Modules that define classes of options with limits."""


def _classes(module: str) -> list[type]:
    values = vars(importlib.import_module(module)).values()
    return [value for value in values if isinstance(value, type) and value.__module__ == module and _is_limited(value)]


def _is_limited(cls: type) -> bool:
    return "__limits_of__" in vars(cls)


def _bad_values(annotation: Any, limit: msgspec.Meta | None = None) -> Iterator[Any]:
    """Yield values just outside of what an annotation allows."""
    origin, kinds = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        yield from _bad_values(annotation.__origin__, annotation.__metadata__[0])
    elif origin is Literal:
        yield "no such name"
    elif annotation is bool:
        yield "yes"
    elif origin is Mapping:
        yield from (3, "text", ["x"])
        yield from ({"name": bad} for bad in _bad_values(kinds[-1]))
    elif isinstance(annotation, type) and (annotation is str or is_dataclass(annotation)) and limit is None:
        yield from (3, 2.5, ["x"])
    elif annotation is str:
        # A list has a length too.
        yield from (3, 2.5, ["x"])
        yield from ("x" * size for size in [(limit.min_length or 0) - 1, (limit.max_length or -2) + 1] if size >= 0)
    elif annotation in (int, float):
        yield "text"
        yield math.nan
        if annotation is int:
            yield 2.5
        if limit is not None:
            step = 1 if annotation is int else 1e-9
            yield from (bound for bound in (limit.gt, limit.lt) if bound is not None)
            yield from (limit.ge - step * max(1, abs(limit.ge)) for _ in [0] if limit.ge is not None)
            yield from (limit.le + step * max(1, abs(limit.le)) for _ in [0] if limit.le is not None)
        if limit is None or not (limit.extra or {}).get("infinite"):
            yield math.inf
    elif origin in (tuple, list):
        fixed = origin is tuple and kinds[-1] is not Ellipsis
        good = [_good_value(kind) for kind in (kinds if fixed else kinds[:1])]
        if fixed:
            yield (*good, good[-1])
        if limit is not None and limit.min_length:
            yield ()
        if None not in good:
            yield from ((bad, *good[1:]) for bad in _bad_values(kinds[0]) if bad != "text")
    elif type(None) in kinds and len(kinds) == 2:
        yield from _bad_values(next(kind for kind in kinds if kind is not type(None)))


def _good_value(annotation: Any, limit: msgspec.Meta | None = None) -> Any:
    """Return a value that an annotation allows, on its bound if it has one; None for kinds that are not limited."""
    origin, kinds = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _good_value(annotation.__origin__, annotation.__metadata__[0])
    if origin is Literal:
        return kinds[0]
    if origin in (Union, UnionType) and type(None) not in kinds:
        return _good_value(kinds[0])
    if origin is tuple:
        return tuple(map(_good_value, kinds[:1] if kinds[-1] is Ellipsis else kinds))
    if annotation in (int, float):
        least, most = (limit.ge, limit.le) if limit is not None else (None, None)
        above, below = (limit.gt, limit.lt) if limit is not None else (None, None)
        if least is not None or most is not None:
            return annotation(least if least is not None else most)
        low, high = above if above is not None else (below or 2) - 2, below if below is not None else (above or 0) + 2
        return annotation((low + high) / 2)
    if annotation is str:
        return "x" * (limit.min_length or 1 if limit is not None else 1)
    if origin is Mapping:
        return {}
    if isinstance(annotation, type) and is_dataclass(annotation):
        return object.__new__(annotation)
    return None


def _holds_dataclasses(annotation: Any) -> bool:
    return is_dataclass(annotation) or any(map(_holds_dataclasses, get_args(annotation)))


def _is_finite(value: Any) -> bool:
    if isinstance(value, tuple | dict):
        return all(map(_is_finite, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or math.isfinite(value)


@pytest.mark.parametrize("module", MODULES)
def test_every_field_takes_its_bounds_and_nothing_beyond(module: str):
    for cls in _classes(module):
        limits = limits_of(cls)
        assert limits, f"{cls.__name__} limits nothing"
        if inspect.isabstract(cls):
            continue  # its subclasses are tested
        good = object.__new__(cls)
        for item in fields(cls):
            default = item.default_factory() if item.default_factory is not MISSING else item.default
            object.__setattr__(good, item.name, _good_value(limits.get(item.name)) if default is MISSING else default)
        for name, annotation in limits.items():
            if (bound := _good_value(annotation)) is not None:
                check_value(name, bound, annotation)
            for bad in _bad_values(annotation):
                options = copy.copy(good)
                object.__setattr__(options, name, bad)
                with pytest.raises(UsageError, match=re.escape(name)):
                    check_limits(options)
                if _holds_dataclasses(annotation):
                    continue  # no file is converted to these
                # No file that is read here holds NaN or infinity.
                with (
                    pytest.raises(msgspec.ValidationError)
                    if _is_finite(bad)
                    else contextlib.suppress(msgspec.ValidationError)
                ):
                    msgspec.convert(list(bad) if isinstance(bad, tuple) else bad, annotation)


@pytest.mark.parametrize("module", MODULES)
def test_every_class_with_limits_checks_them_when_it_is_made(module: str):
    def below(base: type) -> Iterator[type]:
        yield base
        for inner in base.__subclasses__():
            yield from below(inner)

    for cls in {inner for base in _classes(module) for inner in below(base)}:
        assert getattr(cls.__post_init__, "checks_limits", False), f"{cls.__name__} checks nothing"


@limited
class Cell:
    size: Count = 1


@limited
class Stepping:
    step: Count = 1


@limited(of="{} of a table")
class Table:
    title: str = ""
    cells: tuple[Cell | Stepping, ...] = ()
    weights: Mapping[str, NotNegative] = field(default_factory=dict)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"title": 3}, "The title of a table must be a text; received 3 (int)."),
        ({"cells": (3,)}, "The cells of a table must be Cell(…) or Stepping(…); received 3 (int)."),
        ({"weights": [1]}, "The weights of a table must be names and values; received [1] (list)."),
        ({"weights": {"a": -1}}, "weights of a table (a) must be a finite number, at least 0; received -1."),
    ],
)
def test_texts_parts_and_mappings_are_limits_too(values: dict[str, Any], sentence: str):
    assert Table(title="a", cells=[Cell()], weights={"a": 0}).title == "a"
    with pytest.raises(UsageError) as error:
        Table(**values)
    assert str(error.value) == sentence


@limited(of="{} of a grid")
class Grid:
    step: Annotated[float, Limit(above=0, most=5e-3, unit="m")] = 1e-4
    count: Count | None = None
    order: Literal["first", "second"] = "first"
    corner: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sizes: Annotated[tuple[Count, ...], Limit(shortest=1, longest=3)] = (1,)
    width: float | tuple[float, float] = 1.0
    reach: Annotated[float, Limit(least=0, infinite=True)] = math.inf
    closed: bool = False
    names: tuple[str, ...] = ()
    made: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.closed and self.width != 1:
            raise UsageError("A closed grid has no width.")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"step": 0}, "step of a grid (m) must be a finite number, at most 0.005 and above 0; received 0."),
        ({"step": math.nan}, "received nan."),
        ({"step": True}, "received True."),
        ({"count": 0}, "count of a grid must be a whole number, at least 1; received 0."),
        ({"count": 2.0}, "received 2.0."),
        ({"order": "frist"}, "Unknown order of a grid 'frist'; did you mean 'first'? Allowed: 'first', 'second'."),
        ({"corner": (1, 2)}, "corner of a grid holds 3 numbers; received (1, 2)."),
        ({"corner": 3}, "corner of a grid holds 3 numbers; received 3."),
        ({"corner": {1, 2, 3}}, "corner of a grid holds 3 numbers; received {1, 2, 3}."),
        ({"sizes": (1, 0)}, "sizes of a grid must be a whole number, at least 1; received 0."),
        ({"sizes": ()}, "sizes of a grid holds at least 1 and at most 3 values; received []."),
        ({"width": (1.0,)}, "width of a grid holds 2 numbers; received (1.0,)."),
        ({"width": "x"}, "width of a grid must be a finite number; received 'x'."),
        ({"reach": -math.inf}, "reach of a grid must be a finite number, at least 0; received -inf."),
        ({"closed": 1}, "closed of a grid must be True or False; received 1."),
        ({"closed": True, "width": 2.0}, "A closed grid has no width."),
    ],
)
def test_an_error_says_what_was_received_and_what_is_allowed(values, words):
    with pytest.raises(UsageError) as caught:
        Grid(**values)
    assert words in str(caught.value)


def test_numpy_numbers_arrays_and_none_are_taken():
    Grid(step=np.float32(1e-3), count=np.int64(3), corner=np.zeros(3), width=2, closed=np.bool_(False))


def test_files_and_words_read_the_same_annotations():
    with pytest.raises(msgspec.ValidationError, match=r"`float` > 0.0 - at `\$.step`"):
        msgspec.convert({"step": 0}, Grid)
    assert bounds_of(limits_of(Grid)["step"]) == "above 0, at most 0.005"
    assert bounds_of(limits_of(Grid)["count"]) == "at least 1"


def test_an_annotation_that_cannot_be_resolved_is_an_error_of_the_class():
    @limited
    class Broken:
        step: NoSuchLimit = 1.0  # type: ignore[name-defined] # noqa: F821

    with pytest.raises(TypeError, match=r"Broken\.step are unknown.*NoSuchLimit"):
        Broken()


def test_limits_that_nothing_reads_are_an_error_of_the_class():
    @limited
    class Misplaced:
        step: Annotated[int | None, Limit(least=1)] = None

    with pytest.raises(TypeError, match="behind a number"):
        Misplaced()


def test_the_decorator_makes_the_dataclass_itself():
    assert fields(Solver)[0].name == "step"
    with pytest.raises(FrozenInstanceError):
        Solver().step = 1.0  # type: ignore[misc]
    with pytest.raises(TypeError, match="take @dataclass off Late"):
        limited(dataclass(type("Late", (), {"__annotations__": {"step": float}})))


@limited
class Solver:
    step: Annotated[float, Limit(above=0)] = 1e-3
    iterations: Count | None = 5
    order: Literal["first", "second"] = "first"
    twist: bool | None = None


@dataclass(frozen=True)
class Job:
    name: str = "press"
    solver: Solver = field(default_factory=Solver)
    corner: tuple[float, float] = (0.0, 0.0)
    sizes: tuple[int, ...] = (1,)


def test_words_change_fields_and_those_of_parts():
    words = ["name=slide", "solver.step=2e-3", "solver.iterations=none", "solver.twist=True", "corner=1, 2", "sizes=3"]
    job = with_changes(Job(), read_pairs(words, "--change", "name=slide"))
    assert job == Job("slide", Solver(2e-3, None, twist=True), (1.0, 2.0), (3,))


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("nme=slide", "Unknown field of Job 'nme'; did you mean 'name'?"),
        ("solver.stp=1", "Unknown field of Solver 'stp'; did you mean 'step'?"),
        ("solver.step=fast", "'step' takes a number, for instance 0.001; received 'fast'."),
        ("solver.step=nan", "'step' takes a number, for instance 0.001; received 'nan'."),
        ("solver.step=0", "step must be a finite number, above 0; received 0.0."),
        ("solver.iterations=2.5", "'iterations' takes a whole number, for instance 5; received '2.5'."),
        ("solver.order=frist", "did you mean 'first'?"),
        ("solver.twist=maybe", "'twist' takes true or false; received 'maybe'."),
        ("corner=1,x", "'corner' takes numbers joined by commas, for instance (0.0, 0.0); received '1,x'."),
        ("solver=3", "'solver' is more than a number; change it in Python, with dataclasses.replace."),
        ("name.first=3", "'name' has no parts; received 'name.first'."),
        ("name", "--change takes name=value, such as name=slide; received 'name'."),
    ],
)
def test_a_word_that_cannot_be_read_is_answered_in_one_sentence(word: str, message: str):
    with pytest.raises(UsageError, match=re.escape(message)):
        with_changes(Job(), read_pairs([word], "--change", "name=slide"))


def test_a_name_stands_once():
    with pytest.raises(UsageError, match="--fault names 'drop' more than once"):
        read_pairs(["drop=1", "drop = 2"], "--fault", "drop=0.2")


def test_values_without_annotation_are_read_like_the_present_ones():
    assert read_value("clip", "2", kind_of(1.0)) == 2.0
    assert read_value("count", "2", kind_of(1)) == 2
    assert read_value("target", "0,0,.5", kind_of((0.0, 0.0, 1.0))) == (0.0, 0.0, 0.5)
    assert read_value("limit", "3", kind_of(None)) == 3.0


@limited(of="{} of a draw")
class _Draw:
    span: Annotated[tuple[float, float], Limit(rising=True)] | None = None


def test_a_range_is_in_order_also_where_it_comes_from_a_file() -> None:
    assert _Draw((1.0, 1.0)).span == (1.0, 1.0)
    with pytest.raises(UsageError, match=r"span of a draw is a range \(low, high\); received \(2.0, 1.0\)"):
        _Draw((2.0, 1.0))
    with pytest.raises((UsageError, msgspec.ValidationError), match="is a range"):
        msgspec.convert({"span": [2.0, 1.0]}, _Draw)
    with pytest.raises(UsageError, match="is a range"):
        with_changes(_Draw((0.0, 1.0)), {"span": "2,1"})
