"""Sound of contacts and drives, a block of samples per update (thesis 4.32–4.34). SI: metres, seconds, newtons.

A source is a bank of damped resonators excited by the engine's contacts; it emits the velocity of the struck
surface (m/s) when its modes come from :func:`robotics_bridge.sensors.audio.modes.find_modes`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from brainbench.core.reading.ranges import check_fields
from robotics_bridge.sensors.audio.materials import Modes
from robotics_bridge.sensors.sensor import Sensor


@dataclass(frozen=True, kw_only=True)
class AudioSensor(Sensor):
    """A sensor that reads a block of samples [N, K] per update."""

    samples: int = 160
    """K: the sample rate is K over the time step."""

    units: ClassVar[str] = "m/s"
    shared: ClassVar[tuple[str, ...]] = ("samples",)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, "samples", least=1, whole=True)

    @property
    def channels(self) -> int:  # type: ignore[override]
        """Samples per reading."""
        return self.samples


@dataclass(frozen=True, kw_only=True)
class ContactAudio(AudioSensor):
    """Sound of a link that is struck and rubbed: [1, K] samples.

    A rise of the summed normal force by more than ``threshold`` within one update is an impact of the impulse
    ΔF·Δt; sliding is noise of the strength F·v. Engines that give no contact forces are silent.
    """

    shared: ClassVar[tuple[str, ...]] = ("samples", "quads")
    runtime: ClassVar[str] = "robotics_bridge.sensors.audio.runtime:ContactAudioRuntime"

    modes: Modes
    """Modes of the link, from ``find_modes`` or by hand."""
    threshold: float = 0.1
    """Smallest rise of force that is an impact [N]."""
    impact: float = 1.0
    """Factor on impulses."""
    scrape: float = 0.05
    """Density of the force noise of sliding [N·√s per N·m/s]."""
    contact_time: float = 0.0
    """Duration of an impact's pulse [s]: longer ones excite high modes less. At most the time step; 0 is one sample."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, "threshold", "impact", "scrape", "contact_time", least=0)

    def layout(self) -> tuple[int, ...]:
        """Return the shape of one emitter."""
        return (1,)

    @property
    def quads(self) -> int:
        """Number of vectors of four that hold its modes."""
        return (len(self.modes.frequency) + 3) // 4


@dataclass(frozen=True, kw_only=True)
class ActuationAudio(AudioSensor):
    """Sound of the drives of a hand: [J, K] samples, one emitter per joint.

    Loudness is β_load |τ| + β_pow |τ ω|, the whine a bank of partials on κ |ω|. Write torque and speed of the joints
    to the views of :func:`robotics_bridge.sensors.audio.runtime.joint_drive` before each update.
    """

    runtime: ClassVar[str] = "robotics_bridge.sensors.audio.runtime:DriveAudioRuntime"

    joints: int
    """J."""
    load: float = 1e-3
    """β_load [1/(N·m)], in units of the output."""
    power: float = 1e-3
    """β_pow [1/W]."""
    pitch: float = 80.0
    """κ: frequency of the fundamental per speed [Hz per rad/s], i.e. the teeth that mesh per radian."""
    partials: int = 4
    rolloff: float = 0.5
    """Amplitude of a partial relative to the one below."""
    friction: float = 1e-4
    """Noise per speed [1/(rad/s)]."""
    hum: float = 0.0
    """Amplitude of the idle hum."""
    hum_frequency: float = 100.0
    """[Hz]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, "joints", least=1, whole=True)
        check_fields(self, "partials", least=0, whole=True)
        check_fields(self, "load", "power", "pitch", "rolloff", "friction", "hum", "hum_frequency", least=0)

    def layout(self) -> tuple[int, ...]:
        """Return the shape of one emitter per joint."""
        return (self.joints,)
