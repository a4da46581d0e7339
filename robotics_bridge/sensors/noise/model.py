"""Noise model of a real sensor, as in the thesis (equations 4.22–4.28, tables 4.2 and 4.12).

Order of the measured branch: radius noise and gain → crosstalk → hysteresis → random walk → white noise → bias →
quantisation → dead probes → threshold → delay. The ground truth is never touched. Values are drawn by counter
(:mod:`robotics_bridge.sensors.kernels.noise`): they depend on seed, sensor name, environment, episode, update,
probe and channel, and on nothing else. Letters: B environment, N probe, C channel; arrays are planar [C, B, N].
"""

from __future__ import annotations

import hashlib
import os
import struct
from dataclasses import fields
from typing import Annotated, Any

from brainbench.core.devices import warp
from brainbench.core.errors import DataError, UsageError, check_name, listing
from brainbench.core.files import read_json, to_plain, write_json
from brainbench.core.limits import Limit, NotNegative, Share, limited
from brainbench.core.reading.regular import readable

BASE_KNOBS = frozenset({"read_delay", "jitter", "white", "bias", "walk", "quantum"})
"""Knobs of every sensor (table 4.2)."""
PROBE_KNOBS = BASE_KNOBS | {"radius"}  # knobs of probe sensors
TAXEL_KNOBS = PROBE_KNOBS | {"gain", "dead_probability", "dead_range", "hysteresis", "hysteresis_tau"}
"""Knobs of tactile probe sensors."""
GRID_KNOBS = TAXEL_KNOBS | {"crosstalk", "crosstalk_sigma"}
"""Knobs of sensors whose taxels may lie on a grid and share a soft layer."""
_FORMAT = "brainbench-noise-1"


@limited(kw_only=True)
class Noise:
    """Imperfections of one sensor; every knob is off by default."""

    read_delay: NotNegative = 0.0
    """Age of what is read [s]; a zero-order hold between updates."""
    jitter: NotNegative = 0.0
    """Half width of the uniform variation of the delay [s], at most the delay."""
    white: NotNegative = 0.0
    """Standard deviation of Gaussian noise, new in every update [unit of the sensor]."""
    bias: float = 0.0
    """Constant offset [unit of the sensor]."""
    walk: NotNegative = 0.0
    """Standard deviation of the step that a drift makes in every update [unit of the sensor]."""
    quantum: NotNegative = 0.0
    """Step of the analogue-to-digital converter [unit of the sensor]; 0 does not round."""
    radius: NotNegative = 0.0
    """Half width of the uniform error of the sensing radius, new in every update [m] (4.23)."""
    gain: Annotated[tuple[NotNegative, NotNegative], Limit(rising=True)] = (1.0, 1.0)
    """Range of each probe's calibration factor, drawn at every reset (4.24). It multiplies the depth."""
    dead_probability: Share = 0.0
    """Probability that a probe is stuck for an episode (4.25)."""
    dead_range: Annotated[tuple[float, float], Limit(rising=True)] = (0.0, 0.0)
    """Range of the stuck value; one value fills all channels of the probe [unit of the sensor]."""
    hysteresis: float = 0.0
    """Strength β of the viscoelastic overshoot (4.26, 4.27)."""
    hysteresis_tau: NotNegative = 0.05
    """Its time constant τ [s]."""
    crosstalk: Share = 0.0
    """Share χ of the signal that spreads over neighbours of a planar grid (4.28)."""
    crosstalk_sigma: NotNegative = 1.0
    """Standard deviation of that spread [taxels]."""

    def __post_init__(self) -> None:
        for name in ("gain", "dead_range"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        if self.jitter > self.read_delay:
            raise UsageError(
                f"jitter ({self.jitter:g} s) must not exceed read_delay ({self.read_delay:g} s): "
                "a reading from the future is none."
            )
        if self.hysteresis and not self.hysteresis_tau:
            raise UsageError("hysteresis needs a positive hysteresis_tau (s); received 0.")
        if self.crosstalk and not self.crosstalk_sigma:
            raise UsageError("crosstalk needs a positive crosstalk_sigma (taxels); received 0.")

    @property
    def set_knobs(self) -> tuple[str, ...]:
        """Names of the knobs that do something."""
        names = [field.name for field in fields(self) if getattr(self, field.name) != field.default]
        with_switch = {
            "dead_range": self.dead_probability,
            "hysteresis_tau": self.hysteresis,
            "crosstalk_sigma": self.crosstalk,
        }
        return tuple(name for name in names if with_switch.get(name, 1.0))

    @property
    def active(self) -> bool:
        """True if the measured reading can differ from the truth."""
        return bool(self.set_knobs)

    def check(self, knobs: frozenset[str], sensor: str) -> None:
        """Refuse knobs that a sensor does not have (table 4.2)."""
        if extra := [name for name in self.set_knobs if name not in knobs]:
            raise UsageError(
                f"{sensor} has no noise knob {', '.join(map(repr, extra))}; it has: {', '.join(sorted(knobs))}."
            )

    def save(self, path: str | os.PathLike[str], **about: Any) -> None:
        """Write the knobs as a preset (JSON), with what else is worth telling about it."""
        write_json(path, {"format": _FORMAT, "noise": to_plain(self), "about": about})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Noise:
        """Read a preset that :meth:`save` or ``brainbench tactile calibrate`` wrote."""
        document = read_json(path, "noise preset")
        knobs = document.get("noise") if isinstance(document, dict) else None
        if not isinstance(knobs, dict) or document.get("format") != _FORMAT:
            raise DataError(f"{str(path)!r} is no noise preset (format {_FORMAT!r}).")
        names = {field.name for field in fields(cls)}
        if unknown := [name for name in knobs if name not in names]:
            raise DataError(f"{str(path)!r} holds unknown noise knobs: {listing(unknown)}.")
        values: dict[str, Any] = {name: tuple(item) if isinstance(item, list) else item for name, item in knobs.items()}
        with readable(path, "noise preset"):
            return cls(**values)

    @classmethod
    def preset(cls, name: str) -> Noise:
        """Return a named preset; :data:`PRESETS` lists them."""
        check_name("noise preset", name, PRESETS)
        return PRESETS[name]


def _published(**knobs: Any) -> Noise:
    scatter = {"gain": (0.85, 1.15), "hysteresis": 0.5, "hysteresis_tau": 0.05}
    return Noise(dead_probability=0.05, **scatter, **knobs)


PRESETS: dict[str, Noise] = {
    "none": Noise(),
    "published-bool": Noise(dead_probability=0.05),
    "published-depth": _published(white=2e-4, quantum=1e-4, radius=3e-4),
    "published-force": _published(white=5e-3, walk=1e-4, quantum=1e-2, radius=3e-4),
    "published-proximity": _published(white=1e-2, walk=1e-3, quantum=1e-2, radius=6e-4),
    "published-elastomer": _published(white=1e-4, walk=1e-5, quantum=1e-4, radius=3e-4),
}
"""The noisy condition of the thesis (table 4.12), by group of observation types. The release threshold of
``bool`` (2·10⁻⁴ m) belongs to the ContactProbe."""
for _alias, _name in {"agg_bool": "bool", "agg_force": "depth", "force_torque": "force"}.items():
    PRESETS[f"published-{_alias}"] = PRESETS[f"published-{_name}"]


def stream_key(seed: int, name: str) -> dict[str, Any]:
    """Return both halves of the key of a sensor's random numbers, a stable hash of seed and name."""
    # A hash and not the sensor's number: adding a sensor leaves the noise of the others as it was.
    low, high = struct.unpack("<II", hashlib.sha256(f"{seed}:{name}".encode()).digest()[:8])
    return {"key_low": warp().uint32(low), "key_high": warp().uint32(high)}
