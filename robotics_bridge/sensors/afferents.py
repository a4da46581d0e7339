"""Touch as the afferents of the hand pass it on: bands of SA-I, FA-I and FA-II (thesis, table 2.1).

Slowly adapting type I (Merkel) follows static indentation and slow change; fast adapting type I (Meissner) skin
motion of 5 to 50 Hz; fast adapting type II (Pacini) vibration of 40 to 400 Hz. Filters are causal and run update by
update on the device of the signal. Letters: B environment, … anything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import butter, sosfilt_zi

from brainbench.core.errors import UsageError, brief, check_each, check_number

if TYPE_CHECKING:
    import torch

    from robotics_bridge.physics.state import EnvIds


AFFERENTS = {"SA-I": (0.0, 5.0), "FA-I": (5.0, 50.0), "FA-II": (40.0, 400.0)}
"""Lower and upper edge [Hz] of the bands of table 2.1; 0 passes static signals."""
_ORDER = 2  # order of the Butterworth filter at each edge


def band_sections(name: str, rate: float) -> np.ndarray:
    """Return the second-order sections [n, 6] of one of :data:`AFFERENTS` at a sample rate (Hz)."""
    low, high = AFFERENTS[name]
    if high >= rate / 2:
        raise UsageError(
            f"A band up to {high:g} Hz needs more than {2 * high:g} readings per second; received {rate:g}. Read the "
            "sensor at every sub-step, or leave the band out."
        )
    if low == 0:
        return np.asarray(butter(_ORDER, high, "lowpass", fs=rate, output="sos"))
    return np.asarray(butter(_ORDER, (low, high), "bandpass", fs=rate, output="sos"))


class AfferentFilter:
    """Splits a signal into bands, one update at a time.

    Args:
        rate: Updates per second [Hz].
        bands: Names of :data:`AFFERENTS`.

    Example::

        afferents = AfferentFilter(1000.0)
        bands = afferents.step(suite.read("tip"))  # {"SA-I": [B, N], "FA-I": …}
    """

    def __init__(self, rate: float, bands: Sequence[str] = tuple(AFFERENTS)) -> None:
        check_number("rate (Hz)", rate, above=0)
        self.rate, self.bands = rate, (bands,) if isinstance(bands, str) else tuple(bands)
        check_each("afferent", self.bands, AFFERENTS)
        if not self.bands:
            raise UsageError(f"A filter needs a band, such as {next(iter(AFFERENTS))!r}; received none.")
        self._sections = {name: band_sections(name, rate) for name in self.bands}
        self._state: dict[str, list[list[torch.Tensor]]] = {}

    def step(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return name → filtered signal, in the shape of ``x`` [B, …].

        The first signal counts as having lasted for ever, so that contact before it rings in no band. A value that is
        not finite stays in its memory until :meth:`reset`.
        """
        self._check(x)
        if not self._state:
            self._state = {name: self._rest(name, x) for name in self.bands}
        filtered = {}
        for name, sections in self._sections.items():
            y = x
            for row, (first, second) in zip(sections, self._state[name], strict=True):
                # Second-order sections in transposed direct form II: two memories each, and little rounding in single
                # precision where one long polynomial would lose the poles near 1.
                b0, b1, b2, _a0, a1, a2 = (float(value) for value in row)
                out = b0 * y + first
                first.copy_(b1 * y - a1 * out + second)
                second.copy_(b2 * y - a2 * out)
                y = out
            filtered[name] = y
        return filtered

    def reset(self, env_ids: EnvIds | None = None, x: torch.Tensor | None = None) -> None:
        """Forget the past of some environments (all by default); the signal ``x`` [B, …], or 0, was always there."""
        from robotics_bridge.physics.state import select_envs

        if env_ids is None and x is None:
            self._state = {}
            return
        if x is not None:
            self._check(x)
        if self._shape is None:
            return
        device = next(iter(self._state.values()))[0][0].device
        chosen = select_envs(env_ids, self._shape[0], device)
        for name, state in self._state.items():
            rest = self._rest(name, x if x is not None else state[0][0].new_zeros(self._shape))
            for pair, fresh in zip(state, rest, strict=True):
                for memory, value in zip(pair, fresh, strict=True):
                    memory[chosen] = value[chosen]

    def _check(self, x: torch.Tensor) -> None:
        if not (hasattr(x, "is_floating_point") and x.is_floating_point()):
            raise UsageError(f"A signal is a torch tensor [B, …] of floating-point numbers; received {brief(x)}.")
        if self._shape is not None and x.shape != self._shape:
            raise UsageError(f"A signal keeps its shape, {tuple(self._shape)}; received {tuple(x.shape)}.")

    @property
    def _shape(self) -> torch.Size | None:
        return next(iter(self._state.values()))[0][0].shape if self._state else None

    def _rest(self, name: str, x: torch.Tensor) -> list[list[torch.Tensor]]:
        """Return the memories at which a constant signal stays as it is: those of a unit step, times the signal."""
        level = x.double()
        return [[(level * float(z)).to(x.dtype) for z in pair] for pair in sosfilt_zi(self._sections[name])]
