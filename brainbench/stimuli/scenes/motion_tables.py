"""Motions in a scene file: of heads, of objects and of whiskers. The keys are documented with the scene file itself."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from brainbench.core.errors import UsageError, unknown_name
from brainbench.stimuli.motion import trajectories
from brainbench.stimuli.motion.trajectories import ROTATIONS, Spin, Still, Translation, Whisking
from brainbench.stimuli.scenes.toml_tables import MILLI, TomlTable, listed, number, text, vector

if TYPE_CHECKING:
    from brainbench.stimuli.motion.recorded import Recorded
    from brainbench.stimuli.motion.trajectories import Rotations

Moving = TypeVar("Moving")

_DEGREE = math.pi / 180
_WHISKINGS = ("sinusoid", "still", "recorded")


def read_head_motion(table: TomlTable) -> Still | Translation | trajectories.Path:
    """Return how a head moves: a velocity, keyframes, or not at all.

    Raises:
        UsageError: there are keyframes and a velocity, or keyframes without times.
    """
    return _only(table, "a velocity or keyframes", _translation(table), _keyframes(table))


def read_object_motion(table: TomlTable) -> Still | Translation | Spin | trajectories.Path:
    """Return how an object moves: a velocity, a spin, keyframes, or not at all.

    Raises:
        UsageError: there are several of these, or keyframes without times.
    """
    return _only(table, "a velocity, a spin or keyframes", _translation(table), _spin(table), _keyframes(table))


def _only(table: TomlTable, choice: str, *motions: Moving | None) -> Moving | Still:
    given = [item for item in motions if item is not None]
    if len(given) > 1:
        raise UsageError(f"{table.name} takes {choice}, not several; keyframes can do all of it.")
    return given[0] if given else Still()


def _translation(table: TomlTable) -> Translation | None:
    velocity = table.take("velocity_mm_s", vector(MILLI), None)
    onset = table.take("velocity_onset_ms", number(MILLI), None)
    if velocity is None:
        return None
    return Translation(velocity) if onset is None else Translation(velocity, onset)


def _spin(table: TomlTable) -> Spin | None:
    velocity = table.take("spin_deg_s", vector(_DEGREE), None)
    onset = table.take("spin_onset_ms", number(MILLI), None)
    if velocity is None:
        return None
    return Spin(velocity) if onset is None else Spin(velocity, onset)


def _keyframes(table: TomlTable) -> trajectories.Path | None:
    keys = ("times_ms", "path_mm", "path_deg")
    times = table.take(keys[0], listed(number(MILLI)), None)
    places = table.take(keys[1], listed(vector(MILLI)), None)
    turns = table.take(keys[2], listed(vector(_DEGREE)), None)
    if times is None:
        if places is None and turns is None:
            return None
        raise UsageError(f"{table.name} needs the key {keys[0]!r} beside its path.")
    still = ((0.0, 0.0, 0.0),) * len(times)
    return trajectories.Path(times, still if places is None else places, still if turns is None else turns)


def read_whisking(table: TomlTable, folder: Path) -> Still | Whisking | Recorded:
    """Return what ``[whisking]`` says; paths are relative to ``folder``."""
    kind = table.take("kind", text, "sinusoid")
    if kind not in _WHISKINGS:
        raise unknown_name("kind of whisking", kind, _WHISKINGS)
    usual = Whisking()
    name = table.take("rotations", text, usual.rotations.name)
    if name not in ROTATIONS:
        raise unknown_name("set of rotations", name, ROTATIONS)
    whisking = Whisking(
        frequency=table.take("frequency_hz", number(1.0), usual.frequency),
        protraction=table.take("protraction_deg", number(_DEGREE), usual.protraction),
        retraction=table.take("retraction_deg", number(_DEGREE), usual.retraction),
        onset=table.take("onset_ms", number(MILLI), usual.onset),
        rotations=ROTATIONS[name],
    )
    recorded = _recorded(table, folder, ROTATIONS[name]) if kind == "recorded" else None
    table.finish()
    return recorded or (whisking if kind == "sinusoid" else Still())


def _recorded(table: TomlTable, folder: Path, rotations: Rotations) -> Recorded:
    from brainbench.stimuli.motion.recorded import Recorded, load_initial_angles, load_trajectory

    layout = table.take("layout", text, None)
    rate = table.take("rate_hz", number(1.0), 1000.0)
    initial = table.take("initial_path", text, None)
    return Recorded(
        load_trajectory(folder / table.take("path", text), layout=layout, rate=rate),
        start=table.take("start_deg", number(_DEGREE), 0.0),
        rotations=rotations,
        initial={} if initial is None else load_initial_angles(folder / initial, layout=layout),
    )
