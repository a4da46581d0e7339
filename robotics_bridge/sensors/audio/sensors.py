"""Sound of contacts and drives, a block of samples per update (thesis 4.32–4.34). SI: metres, seconds, newtons.

A source is a bank of damped resonators excited by the engine's contacts; it emits the velocity of the struck
surface (m/s) when its modes come from :func:`robotics_bridge.sensors.audio.modes.find_modes`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, ClassVar

from brainbench.core.errors import UsageError, check_name, check_number
from brainbench.core.limits import Count, Limit, NotNegative, Positive, limited
from robotics_bridge.sensors.sensor import Sensor


@limited
class ElasticMaterial:
    """An isotropic solid with Rayleigh damping C = α M + β K."""

    young_modulus: Positive
    """E [Pa]."""
    poisson_ratio: Annotated[float, Limit(above=-1, below=0.49)]
    density: Positive
    """[kg/m³]."""
    alpha: NotNegative
    """Damping of the mass [1/s]."""
    beta: NotNegative
    """Damping of the stiffness [s]."""

    def decay(self, frequency: float) -> float:
        """Return the decay rate d = (α + β ω²) / 2 [1/s] of a mode [Hz]."""
        return (self.alpha + self.beta * (2 * math.pi * frequency) ** 2) / 2


ELASTIC_MATERIALS: dict[str, ElasticMaterial] = {
    "wood": ElasticMaterial(1.1e10, 0.25, 750.0, 60.0, 2e-6),
    "steel": ElasticMaterial(2.0e11, 0.29, 7850.0, 5.0, 3e-8),
    "iron": ElasticMaterial(2.1e11, 0.28, 8000.0, 5.0, 1e-7),
    "aluminium": ElasticMaterial(6.9e10, 0.33, 2700.0, 4.0, 5e-8),
    "glass": ElasticMaterial(6.2e10, 0.20, 2600.0, 1.0, 1e-7),
    "ceramic": ElasticMaterial(7.2e10, 0.19, 2700.0, 6.0, 1e-7),
    "plastic": ElasticMaterial(1.4e9, 0.35, 1070.0, 30.0, 1e-6),
    "polycarbonate": ElasticMaterial(2.4e9, 0.37, 1190.0, 0.5, 4e-7),
}
"""Values in use for modal sound (Wang & James, KleinPAT, 2019; aluminium: handbook, damping of its class)."""


def elastic_material(name: str | ElasticMaterial) -> ElasticMaterial:
    """Return a material by name of :data:`ELASTIC_MATERIALS` (``metal`` is steel); a material passes through."""
    if isinstance(name, ElasticMaterial):
        return name
    chosen = "steel" if name == "metal" else name
    check_name("elastic material", chosen, ELASTIC_MATERIALS)
    return ELASTIC_MATERIALS[chosen]


@limited(of="{} of a mode")
class Modes:
    """Damped modes of a solid."""

    frequency: tuple[Positive, ...]
    """[Hz]."""
    decay: tuple[NotNegative, ...]
    """Amplitude decay rate [1/s]."""
    gain: tuple[float, ...]
    """Velocity of the surface per impulse [1/kg]: the mode's normal components where it is struck and heard."""

    def __post_init__(self) -> None:
        if not len(self.frequency) == len(self.decay) == len(self.gain) or not self.frequency:
            raise UsageError(
                f"Modes need as many frequencies as decays and gains; received {len(self.frequency)}, "
                f"{len(self.decay)} and {len(self.gain)}."
            )

    def rows(self) -> Sequence[tuple[float, float, float]]:
        """Return (frequency, decay, gain) of each mode."""
        return list(zip(self.frequency, self.decay, self.gain, strict=True))


def preset_modes(material: str | ElasticMaterial, lowest: float, count: int = 16) -> Modes:
    """Return hand-made modes for a body of a material that is known by ear only.

    The frequencies are those of a free bar, (2n + 1)² / 9 times the lowest one, up to 20 kHz; decays follow the
    material's damping, gains fall with 1/n and are 1/kg at first.
    """
    chosen = elastic_material(material)
    check_number("lowest frequency of a body that is heard (Hz)", lowest, least=20, below=20_000)
    check_number("number of modes", count, least=1, whole=True)
    # Free bar: wave numbers near (2n + 1) π / 2L, and frequencies with their square.
    every = (lowest * (2 * n + 1) ** 2 / 9 for n in range(1, count + 1))
    frequency = tuple(value for value in every if value <= 20_000)
    gain = tuple(1 / n for n in range(1, len(frequency) + 1))
    return Modes(frequency, tuple(chosen.decay(value) for value in frequency), gain)


@limited(kw_only=True)
class AudioSensor(Sensor):
    """A sensor that reads a block of samples [N, K] per update."""

    samples: Count = 160
    """K: the sample rate is K over the time step."""

    units: ClassVar[str] = "m/s"
    shared: ClassVar[tuple[str, ...]] = ("samples",)

    @property
    def channels(self) -> int:  # type: ignore[override]
        """Samples per reading."""
        return self.samples


@limited(kw_only=True)
class ContactAudio(AudioSensor):
    """Sound of a link that is struck and rubbed: [1, K] samples.

    A rise of the summed normal force by more than ``threshold`` within one update is an impact of the impulse
    ΔF·Δt; sliding is noise of the strength F·v. Engines that give no contact forces are silent.
    """

    shared: ClassVar[tuple[str, ...]] = ("samples", "quads")
    runtime: ClassVar[str] = "robotics_bridge.sensors.audio.runtime:ContactAudioRuntime"

    modes: Modes
    """Modes of the link, from ``find_modes`` or by hand."""
    threshold: NotNegative = 0.1
    """Smallest rise of force that is an impact [N]."""
    impact: NotNegative = 1.0
    """Factor on impulses."""
    scrape: NotNegative = 0.05
    """Density of the force noise of sliding [N·√s per N·m/s]."""
    contact_time: NotNegative = 0.0
    """Duration of an impact's pulse [s]: longer ones excite high modes less. At most the time step; 0 is one sample."""

    @property
    def needs(self) -> tuple[str, str]:
        """Speeds of slip, unless it hears impacts alone."""
        return "a speed of slip" if self.scrape else "", "leave out the sound of sliding with scrape=0"

    def layout(self) -> tuple[int, ...]:
        """Return the shape of one emitter."""
        return (1,)

    @property
    def quads(self) -> int:
        """Number of vectors of four that hold its modes."""
        return (len(self.modes.frequency) + 3) // 4


@limited(kw_only=True)
class ActuationAudio(AudioSensor):
    """Sound of the drives of a hand: [J, K] samples, one emitter per joint.

    Loudness is β_load |τ| + β_pow |τ ω|, the whine a bank of partials on κ |ω|. Write torque and speed of the joints
    to the views of :func:`robotics_bridge.sensors.audio.runtime.joint_drive` before each update.
    """

    runtime: ClassVar[str] = "robotics_bridge.sensors.audio.runtime:DriveAudioRuntime"

    joints: Count
    """J."""
    load: NotNegative = 1e-3
    """β_load [1/(N·m)], in units of the output."""
    power: NotNegative = 1e-3
    """β_pow [1/W]."""
    pitch: NotNegative = 80.0
    """κ: frequency of the fundamental per speed [Hz per rad/s], i.e. the teeth that mesh per radian."""
    partials: Annotated[int, Limit(least=0)] = 4
    rolloff: NotNegative = 0.5
    """Amplitude of a partial relative to the one below."""
    friction: NotNegative = 1e-4
    """Noise per speed [1/(rad/s)]."""
    hum: NotNegative = 0.0
    """Amplitude of the idle hum."""
    hum_frequency: NotNegative = 100.0
    """[Hz]."""

    def layout(self) -> tuple[int, ...]:
        """Return the shape of one emitter per joint."""
        return (self.joints,)
