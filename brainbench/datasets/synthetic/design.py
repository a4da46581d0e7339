"""Design of synthetic recordings: how much is recorded, and how noisy it is."""

from __future__ import annotations

from dataclasses import dataclass

from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_fields

MODULATION = 0.4
"""Largest modulation: beyond it too many rates would be cut off at zero for the truth to hold."""


@dataclass(frozen=True)
class PopulationDesign:
    """Size of synthetic recordings, and how noisy they are; the defaults make RDMs of about half reliability."""

    animals: int = 10
    sessions: int = 1
    """Sessions per animal; each has its own units."""
    units: int = 60
    """Units per session."""
    trials: int | tuple[int, int] = (16, 20)
    """Trials of each stimulus in a session: one number, or the fewest and the most, drawn evenly."""
    rate: float = 6.0
    """Mean rate of a unit, Hz."""
    window: float = 0.5
    """Duration in which spikes are counted, s."""
    modulation: float = 0.2
    """Standard deviation of a unit's rate over stimuli, as a share of its mean; 0 is the null."""
    individual: float = 0.0
    """Share of the tuning variance that is an animal's own and not the shared geometry."""
    emphasis: float = 0.3
    """Standard deviation over animals of the logarithm of the weight of each axis of the geometry."""
    spread: float = 0.4
    """Standard deviation of the logarithm of mean rates over units."""
    dispersion: float = 0.2
    """φ of the negative binomial: variance = mean + φ mean² per unit and trial; 0 is Poisson."""
    shared_gain: float = 0.2
    """Standard deviation of a gain (mean one) that all units of a trial share."""
    session_gain: float = 0.0
    """Standard deviation of the logarithm of each session's overall rate."""
    drift: float = 0.0
    """Relative change of all rates from the first trial of a session to the last, above −1."""
    missing: tuple[tuple[int, int], ...] = ()
    """Pairs (animal, stimulus) without any trial."""

    def __post_init__(self) -> None:
        check_fields(self, "animals", "sessions", "units", least=1, whole=True)
        fewest, most = self.trial_range
        if not 1 <= fewest <= most:
            raise UsageError(f"A design needs at least one of trials, fewest before most; received {self.trials}.")
        check_fields(self, "rate", "window", above=0)
        check_fields(self, "emphasis", "spread", "dispersion", "shared_gain", "session_gain", least=0)
        check_fields(self, "modulation", least=0, most=MODULATION)
        check_fields(self, "individual", least=0, most=1)
        check_fields(self, "drift", above=-1)

    @property
    def trial_range(self) -> tuple[int, int]:
        """Fewest and most trials of a stimulus in a session."""
        return (self.trials, self.trials) if isinstance(self.trials, int) else self.trials
