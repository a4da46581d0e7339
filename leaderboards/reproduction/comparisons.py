"""What each claim of the study compares: networks that differ in the one thing that the claim names."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from brainbench.core.statistics import LEVEL
from leaderboards.boards import RAW_INPUT
from leaderboards.reproduction.campaign import NetworkKey
from leaderboards.reproduction.contrasts import Matched
from leaderboards.reproduction.measures import ANIMALS, RANDOM_FEATURES, Measured

_Chosen = tuple[list[Matched], str, float]


def _plain(comparisons: list[Matched]) -> _Chosen:
    return comparisons, "", LEVEL


def _recurrent(key: NetworkKey) -> bool:
    return key.encoder.startswith("zhuang") and "feedforward" not in key.encoder


def _encoders(one: Callable[[NetworkKey], bool], other: Callable[[NetworkKey], bool], objective: str | None) -> Any:
    """Return the choice of comparisons of two kinds of encoders, one comparison for each attender and objective."""

    def chosen(measured: Measured) -> _Chosen:
        found = measured.find(objective=objective)
        groups = sorted({(key.attender, key.objective) for key in found})
        comparisons = []
        for group in groups:
            inside = {key: item for key, item in found.items() if (key.attender, key.objective) == group}
            sides = [tuple(item for key, item in inside.items() if test(key)) for test in (one, other)]
            if all(sides):
                comparisons.append(Matched(*sides))
        return _plain(comparisons)

    return chosen


def _swap(change: Callable[[NetworkKey], NetworkKey | None], **chosen: Any) -> Any:
    """Return the choice that holds every chosen network against the one with something changed."""

    def matched(measured: Measured) -> _Chosen:
        found = measured.find(**chosen)
        pairs = [(item, measured.networks.get(other)) for key, item in found.items() if (other := change(key))]
        return _plain([Matched((item,), (other,)) for item, other in pairs if other is not None])

    return matched


def _variant(name: str, *, reverse: bool = False) -> Any:
    """Return the choice that holds the usual training by SimCLR against a variant, or the reverse."""

    def matched(measured: Measured) -> _Chosen:
        found = [
            (measured.networks.get(key._replace(variant="")), item)
            for key, item in measured.find(objective="simclr", variant=name).items()
        ]
        pairs = [(usual, other) for usual, other in found if usual is not None]
        return _plain([Matched((b,), (a,)) if reverse else Matched((a,), (b,)) for a, b in pairs])

    return matched


def _against(baseline: str, objective: str | None) -> Any:
    def matched(measured: Measured) -> _Chosen:
        base = measured.baselines.get(baseline)
        items = measured.find(objective=objective).values() if base else ()
        return _plain([Matched((item,), (base,)) for item in items if base])

    return matched


def _best(hero: NetworkKey, objective: str | None) -> Any:
    """Return the choice that holds a network against the highest of all others.

    The level of the interval is corrected for the choice of that one (Bonferroni).
    """

    def chosen(measured: Measured) -> _Chosen:
        found = measured.find(objective=objective)
        own = found.pop(hero, None)
        if own is None or not found:
            return _plain([])
        rival = max(found.values(), key=lambda item: item.value)
        return [Matched((own,), (rival,))], f"against {rival.name}", 1 - (1 - LEVEL) / len(found)

    return chosen


def _saturation(measured: Measured) -> _Chosen:
    """Hold the best network, corrected for being the best of many, against animals."""
    found, animals = measured.find(), measured.baselines.get(ANIMALS)
    if not found or animals is None:
        return _plain([])
    best = max(found.values(), key=lambda item: item.value)
    return [Matched((best,), (animals,))], f"{best.name}", 1 - (1 - LEVEL) / len(found)


def _untrained(measured: Measured) -> _Chosen:
    return _plain([Matched((item,)) for item in measured.find(objective="untrained").values()])


def _is(name: str) -> Callable[[NetworkKey], bool]:
    return lambda key: key.encoder == name


_INTERSECTION = "zhuang-intersection-ln"
_CELLS = ("zhuang-ugrnn", "zhuang-intersection", "zhuang-gru", "zhuang-lstm")


def _other_cell(key: NetworkKey) -> bool:
    return _recurrent(key) and not key.encoder.startswith("zhuang-intersection")


def _with_norm(key: NetworkKey) -> NetworkKey | None:
    return key._replace(encoder=key.encoder.removesuffix("-ln")) if key.encoder.removesuffix("-ln") in _CELLS else None


_simclr_for = {
    name: _swap(lambda key, name=name: key._replace(objective=name), objective="simclr")
    for name in ("supervised", "simsiam", "ae")
}
_to_untrained = _swap(lambda key: key._replace(objective="untrained"))
_without_attender = _swap(lambda key: key._replace(attender="none"), attender="gpt", objective="supervised")
_with_mamba = _swap(lambda key: key._replace(attender="mamba"), attender="gpt", objective="supervised")

COMPARISONS: dict[str, Callable[[Measured], _Chosen]] = {
    "best-accuracy": _best(NetworkKey("zhuang", "gpt"), "supervised"),
    "convrnn-resnet-accuracy": _encoders(_recurrent, _is("resnet18"), "supervised"),
    "convrnn-s4-accuracy": _encoders(_recurrent, _is("s4"), "supervised"),
    "intersection-accuracy": _encoders(_is(_INTERSECTION), _other_cell, "supervised"),
    "layer-norm-accuracy": _swap(
        lambda key: _with_norm(key) if key.encoder.endswith("-ln") else None, attender="none", objective="supervised"
    ),
    "gpt-accuracy": _without_attender,
    "gpt-mamba-accuracy": _with_mamba,
    "supervised-simclr-accuracy": _swap(lambda key: key._replace(objective="simclr"), objective="supervised"),
    "trained-accuracy": _to_untrained,
    "tactile-image-accuracy": _variant("image"),
    "masking-accuracy": _variant("masked", reverse=True),
    "raw-accuracy": _against(RAW_INPUT, "supervised"),
    "random-accuracy": _against(RANDOM_FEATURES, "supervised"),
    "best-fit": _best(NetworkKey(_INTERSECTION, "none", "simclr"), None),
    "saturation": _saturation,
    "raw-fit": _against(RAW_INPUT, None),
    "untrained-fit": _untrained,
    "trained-fit": _to_untrained,
    "convrnn-resnet-fit": _encoders(_recurrent, _is("resnet18"), None),
    "convrnn-s4-fit": _encoders(_recurrent, _is("s4"), None),
    "gpt-fit": _without_attender,
    "gpt-mamba-fit": _with_mamba,
    "simclr-supervised-fit": _simclr_for["supervised"],
    "simclr-simsiam-fit": _simclr_for["simsiam"],
    "simclr-ae-fit": _simclr_for["ae"],
    "tactile-image-fit": _variant("image"),
    "masking-fit": _variant("masked", reverse=True),
}
"""The choice of comparisons of each claim: networks, words beside the effect, and the level of its interval."""
