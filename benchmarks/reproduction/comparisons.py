"""Comparisons behind each claim of the study: networks that differ in the one thing that the claim names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from benchmarks.reproduction.campaign import NetworkKey
from benchmarks.reproduction.contrasts import Matched
from benchmarks.reproduction.measures import ANIMALS, RANDOM_FEATURES, Measured
from brainbench.core.statistics import LEVEL
from leaderboards.boards import RAW_INPUT


class Chosen(NamedTuple):
    """Comparisons of a claim."""

    comparisons: list[Matched]
    detail: str = ""
    """Words beside the effect."""
    level: float = LEVEL
    """Level of its interval."""


_Choice = Callable[[Measured], Chosen]


def _encoders(
    one: Callable[[NetworkKey], bool], other: Callable[[NetworkKey], bool], objective: str | None, variant: str = ""
) -> _Choice:
    """Return the choice of comparisons of two kinds of encoders, one comparison for each attender and objective."""

    def chosen(measured: Measured) -> Chosen:
        found = measured.find(objective=objective, variant=variant)
        comparisons = []
        for group in sorted({(key.attender, key.objective) for key in found}):
            inside = {key: item for key, item in found.items() if (key.attender, key.objective) == group}
            sides = [tuple(item for key, item in inside.items() if test(key)) for test in (one, other)]
            if all(sides):
                comparisons.append(Matched(*sides))
        return Chosen(comparisons)

    return chosen


def _swap(change: Mapping[str, str] | Callable[[NetworkKey], NetworkKey], **chosen: Any) -> _Choice:
    """Return the choice that holds every chosen network against the one with something changed."""

    def matched(measured: Measured) -> Chosen:
        comparisons = []
        for key, item in measured.find(**chosen).items():
            changed = change(key) if callable(change) else key._replace(**change)
            if changed != key and (other := measured.networks.get(changed)):
                comparisons.append(Matched((item,), (other,)))
        return Chosen(comparisons)

    return matched


def each(baseline: str | None, objective: str | None) -> _Choice:
    """Return the choice that holds every network against a baseline, or by itself."""

    def matched(measured: Measured) -> Chosen:
        base = measured.baselines.get(baseline or "")
        other = (base,) if base else ()
        items = measured.find(objective=objective).values() if base or baseline is None else ()
        return Chosen([Matched((item,), other) for item in items])

    return matched


def _best(hero: NetworkKey, objective: str | None) -> _Choice:
    """Return the choice that holds a network against the highest of all others.

    The level of the interval is corrected for the choice of that one (Bonferroni).
    """

    def chosen(measured: Measured) -> Chosen:
        found = measured.find(objective=objective)
        own = found.pop(hero, None)
        if own is None or not found:
            return Chosen([])
        rival = max(found.values(), key=lambda item: item.value)
        return Chosen([Matched((own,), (rival,))], f"against {rival.name}", 1 - (1 - LEVEL) / len(found))

    return chosen


def _saturation(measured: Measured) -> Chosen:
    """Hold the best network, corrected for being the best of many, against animals."""
    found, animals = measured.find(), measured.baselines.get(ANIMALS)
    if not found or animals is None:
        return Chosen([])
    best = max(found.values(), key=lambda item: item.value)
    return Chosen([Matched((best,), (animals,))], best.name, 1 - (1 - LEVEL) / len(found))


_INTERSECTION = "zhuang-intersection-ln"
_GATED = ("zhuang-ugrnn", "zhuang-intersection", "zhuang-gru", "zhuang-lstm")


def _recurrent(key: NetworkKey) -> bool:
    return key.encoder.startswith("zhuang") and "feedforward" not in key.encoder


def _other_cell(key: NetworkKey) -> bool:
    return _recurrent(key) and not key.encoder.startswith("zhuang-intersection")


def _is(name: str) -> Callable[[NetworkKey], bool]:
    return lambda key: key.encoder == name


def _without_norm(key: NetworkKey) -> NetworkKey:
    plain = key.encoder.removesuffix("-ln")
    return key._replace(encoder=plain) if plain in _GATED else key


_to_untrained = _swap({"objective": "untrained"})
_without_attender = _swap({"attender": "none"}, attender="gpt", objective="supervised")
_with_mamba = _swap({"attender": "mamba"}, attender="gpt", objective="supervised")
_image = _swap({"variant": "image"}, objective="simclr")
_masked = _swap({"variant": ""}, objective="simclr", variant="masked")
_HIGHER_RATE = "rate 0.01"

COMPARISONS: dict[str, _Choice] = {
    "best-accuracy": _best(NetworkKey("zhuang", "gpt"), "supervised"),
    "convrnn-resnet-accuracy": _encoders(_recurrent, _is("resnet18"), "supervised"),
    "convrnn-s4-accuracy": _encoders(_recurrent, _is("s4"), "supervised"),
    "intersection-accuracy": _encoders(_is(_INTERSECTION), _other_cell, "supervised"),
    "layer-norm-accuracy": _swap(_without_norm, attender="none", objective="supervised"),
    "gpt-accuracy": _without_attender,
    "gpt-mamba-accuracy": _with_mamba,
    "supervised-simclr-accuracy": _swap({"objective": "simclr"}, objective="supervised"),
    "trained-accuracy": _to_untrained,
    "tactile-image-accuracy": _image,
    "masking-accuracy": _masked,
    "raw-accuracy": each(RAW_INPUT, "supervised"),
    "random-accuracy": each(RANDOM_FEATURES, "supervised"),
    "rate-accuracy": _swap({"variant": ""}, objective="supervised", variant=_HIGHER_RATE),
    "rate-convrnn-resnet-accuracy": _encoders(_recurrent, _is("resnet18"), "supervised", _HIGHER_RATE),
    "best-fit": _best(NetworkKey(_INTERSECTION, "none", "simclr"), None),
    "saturation": _saturation,
    "raw-fit": each(RAW_INPUT, None),
    "untrained-fit": each(None, "untrained"),
    "trained-fit": _to_untrained,
    "convrnn-resnet-fit": _encoders(_recurrent, _is("resnet18"), None),
    "convrnn-s4-fit": _encoders(_recurrent, _is("s4"), None),
    "gpt-fit": _without_attender,
    "gpt-mamba-fit": _with_mamba,
    "simclr-supervised-fit": _swap({"objective": "supervised"}, objective="simclr"),
    "simclr-simsiam-fit": _swap({"objective": "simsiam"}, objective="simclr"),
    "simclr-ae-fit": _swap({"objective": "ae"}, objective="simclr"),
    "tactile-image-fit": _image,
    "masking-fit": _masked,
}
"""The choice of comparisons of each claim."""
