"""What a design may choose: how whiskers whisk, and where the objects are."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError, check_each, check_once
from brainbench.stimuli.motion.trajectories import Whisking
from brainbench.stimuli.scenes.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DesignVariable:
    """One thing that may be chosen."""

    unit: str
    low: float
    high: float
    """Usual bounds: those of whisking mice and rats, or a shift of objects (m) against the scenes'."""
    read: Callable[[Scene], float]
    change: Callable[[Scene, float], Scene]


def _whisking(name: str, unit: str, low: float, high: float) -> DesignVariable:
    def change(scene: Scene, value: float) -> Scene:
        return replace(scene, whisking=replace(_sinusoid(scene), **{name: value}))

    return DesignVariable(unit, low, high, lambda scene: getattr(_sinusoid(scene), name), change)


def _sinusoid(scene: Scene) -> Whisking:
    if not isinstance(scene.whisking, Whisking):
        raise UsageError(
            f"The scene {scene.label!r} does not whisk in a sinusoid; only the place of objects can be chosen."
        )
    return scene.whisking


def _shift(axis: int) -> DesignVariable:
    def change(scene: Scene, value: float) -> Scene:
        def moved(position: Sequence[float]) -> Any:
            return tuple(one + value * (index == axis) for index, one in enumerate(position))

        return replace(scene, objects=tuple(replace(item, position=moved(item.position)) for item in scene.objects))

    return DesignVariable("m", -0.003, 0.003, lambda scene: 0.0, change)


VARIABLES: Mapping[str, DesignVariable] = {
    "frequency": _whisking("frequency", "Hz", 4.0, 25.0),
    "protraction": _whisking("protraction", "rad", math.radians(5), math.radians(45)),
    "retraction": _whisking("retraction", "rad", math.radians(0), math.radians(25)),
    **{f"object_{name}": _shift(axis) for axis, name in enumerate("xyz")},
}
"""What can be chosen, by name."""


def read_limits(
    scenes: Sequence[Scene], variables: Sequence[str], bounds: Mapping[str, tuple[float, float]]
) -> tuple[Array, Array]:
    """Return the values [p] of variables in some scenes, and their bounds [p, 2]."""
    check_once("--variables", variables)
    check_each("variable of a design", variables, VARIABLES)
    check_each("chosen variable with bounds", bounds, variables)
    limits = np.array([bounds.get(name, (VARIABLES[name].low, VARIABLES[name].high)) for name in variables])
    first = scenes[0]
    if any(one.names != first.names or one.whisking.config() != first.whisking.config() for one in scenes):
        raise UsageError("The scenes of a design have the same whiskers and the same whisking; these differ.")
    begin = np.array([VARIABLES[name].read(first) for name in variables])
    if not (limits[:, 0] < limits[:, 1]).all():
        raise UsageError(f"The bounds of {', '.join(variables)} are a lower and a higher number each.")
    if (begin < limits[:, 0]).any() or (begin > limits[:, 1]).any():
        raise UsageError(f"The given motion lies outside the bounds of {', '.join(variables)}; widen them.")
    return begin, limits


def changed(scene: Scene, names: Sequence[str], values: Array) -> Scene:
    """Return a scene with variables at some values [p]."""
    for name, value in zip(names, values, strict=True):
        scene = VARIABLES[name].change(scene, float(value))
    return scene
