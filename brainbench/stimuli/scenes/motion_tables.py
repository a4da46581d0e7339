"""Motions in a scene file: of heads, of objects and of whiskers. The keys are documented with the scene file itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from brainbench.core.errors import UsageError
from brainbench.stimuli.motion import trajectories
from brainbench.stimuli.motion.recorded import Recorded
from brainbench.stimuli.motion.trajectories import ROTATIONS, Rotations, Spin, Still, Translation, Whisking
from brainbench.stimuli.scenes.toml_tables import DEGREE, MILLI, Keys, TomlTable, choice, listed, number, text, vector

Moving = TypeVar("Moving")

_WHISKINGS = ("sinusoid", "still", "recorded")
_TRANSLATION: Keys = {
    "velocity": ("velocity_mm_s", vector(MILLI)),
    "onset": ("velocity_onset_ms", number(MILLI)),
}
_SPIN: Keys = {
    "velocity": ("spin_deg_s", vector(DEGREE)),
    "onset": ("spin_onset_ms", number(MILLI)),
}
_PATH: Keys = {
    "times": ("times_ms", listed(number(MILLI))),
    "displacements": ("path_mm", listed(vector(MILLI))),
    "rotations": ("path_deg", listed(vector(DEGREE))),
}
_SINUSOID: Keys = {
    "frequency": ("frequency_hz", number()),
    "protraction": ("protraction_deg", number(DEGREE)),
    "retraction": ("retraction_deg", number(DEGREE)),
    "onset": ("onset_ms", number(MILLI)),
}


def read_head_motion(table: TomlTable) -> Still | Translation | trajectories.Path:
    """Return how a head moves: a velocity, keyframes, or not at all; both are a :class:`UsageError`."""
    given = table.read(_TRANSLATION)
    # The keys of several tables are joined here: an onset for all scenes moves nothing in a scene without velocity.
    steady = Translation(**given) if "velocity" in given else None
    return _only(table, "a velocity or keyframes", steady, _keyframes(table))


def read_object_motion(table: TomlTable) -> Still | Translation | Spin | trajectories.Path:
    """Return how an object moves: a velocity, a spin, keyframes, or not at all; several are a :class:`UsageError`."""
    steady = _smooth(table, Translation, _TRANSLATION), _smooth(table, Spin, _SPIN)
    return _only(table, "a velocity, a spin or keyframes", *steady, _keyframes(table))


def _only(table: TomlTable, choice: str, *motions: Moving | None) -> Moving | Still:
    given = [item for item in motions if item is not None]
    if len(given) > 1:
        raise UsageError(f"{table.name} takes {choice}, not several; keyframes can do all of it.")
    return given[0] if given else Still()


def _smooth(table: TomlTable, make: Callable[..., Moving], keys: Keys) -> Moving | None:
    """Return a motion that reaches a velocity; its onset alone is a :class:`UsageError`."""
    given = table.read(keys)
    if given and "velocity" not in given:
        raise UsageError(f"{table.name} needs the key {keys['velocity'][0]!r} beside {keys['onset'][0]!r}.")
    return make(**given) if given else None


def _keyframes(table: TomlTable) -> trajectories.Path | None:
    given = table.read(_PATH)
    if not given:
        return None
    if "times" not in given:
        raise UsageError(f"{table.name} needs the key {_PATH['times'][0]!r} beside its path.")
    still = ((0.0, 0.0, 0.0),) * len(given["times"])
    return trajectories.Path(**{"displacements": still, "rotations": still, **given})


def read_whisking(table: TomlTable, folder: Path) -> Still | Whisking | Recorded:
    """Return what ``[whisking]`` says; paths are relative to ``folder``."""
    kind = table.take("kind", choice("kind of whisking", _WHISKINGS), "sinusoid")
    rotations = table.take("rotations", choice("set of rotations", ROTATIONS), Whisking().rotations)
    whisking = table.build(Whisking, _SINUSOID, rotations=rotations)
    recorded = _recorded(table, folder, rotations) if kind == "recorded" else None
    table.finish()
    return recorded or (whisking if kind == "sinusoid" else Still())


def _recorded(table: TomlTable, folder: Path, rotations: Rotations) -> Recorded:
    from brainbench.stimuli.motion.recorded import Recorded, load_initial_angles, load_trajectory

    layout = table.take("layout", text, None)
    initial = table.take("initial_path", text, None)
    angles = {} if initial is None else load_initial_angles(folder / initial, layout=layout)
    file: Keys = {"path": ("path", lambda name: folder / text(name)), "rate": ("rate_hz", number())}
    played = table.build(load_trajectory, file, layout=layout)
    start: Keys = {"start": ("start_deg", number(DEGREE))}
    return table.build(Recorded, start, trajectory=played, rotations=rotations, initial=angles)
