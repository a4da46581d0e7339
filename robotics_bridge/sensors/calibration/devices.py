"""A device fitted to presses of a ball, with intervals, and what is wrong with it.

Least squares of whitened readings with weak priors (:data:`PRIORS`); the intervals are those of the posterior near its
maximum. A number whose interval is hardly narrower than its prior was not told by the log. A fault is a number whose
interval lies beyond its tolerance. Letters as in :mod:`robotics_bridge.sensors.calibration.presses`.
"""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm

from brainbench.core.errors import DataError, listing
from robotics_bridge.hands.layouts import write_probes
from robotics_bridge.sensors.calibration.calibrate import find_quantum
from robotics_bridge.sensors.calibration.likelihood import Z95, Estimate, find_delays, fit_dynamics
from robotics_bridge.sensors.calibration.presses import (
    SHARED,
    Answer,
    Device,
    Lag,
    Presses,
    answer,
    crosstalk_of,
    mixed_by,
    readings_of,
    turned_axes,
)
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.sensors.probes.placement import Probes


class Assumption(NamedTuple):
    """What is assumed of a number before the log."""

    middle: float
    spread: float
    low: float
    high: float
    remedy: str
    """What a log must hold to tell it."""


PRIORS = {
    "stiffness": Assumption(0.0, 2.3, -40.0, 40.0, "press to several depths"),
    "exponent": Assumption(1.2, 0.4, 0.3, 4.0, "press to several depths"),
    "damping": Assumption(0.0, 3.0, 0.0, 1e3, "press at several speeds"),
    "friction": Assumption(0.5, 1.0, 0.0, 10.0, "let the ball slide while it presses"),
    "grip": Assumption(2 / 3, 0.5, 0.02, 20.0, "move the ball sideways a little before it slides"),
    "crosstalk": Assumption(0.0, 0.3, 0.0, 0.95, "press where some taxels of a grid are not touched"),
    "hysteresis": Assumption(0.0, 1.0, -5.0, 5.0, "press fast, and hold"),
    "hysteresis_tau": Assumption(
        np.log(0.05), 1.5, -9.0, 5.0, "press fast, and hold (a device without hysteresis has none)"
    ),
    "read_delay": Assumption(0.0, 0.5, 0.0, 10.0, "press and lift at once"),
}
"""Shared number → prior; stiffness is that over the first guess, as a logarithm."""
_LIMITS = np.array([[prior.low, prior.high] for prior in PRIORS.values()]).T
PLACE, TURN, GAIN, BIAS = 1.5e-3, 0.2, 0.3, 1e3
"""Standard deviations of a place (m), a turn (rad), the logarithm of a gain, and a bias over the noise."""
UNTOLD = 0.7
"""Part of its prior's width above which an interval tells nothing."""
TOLERANCES = {"place": 7.5e-4, "turn": np.radians(8.0), "gain": np.log(1.25), "friction": 0.05, "delay": 0.5}
"""What still counts as right: place (m), turn (rad), logarithm of a gain, least friction, readings of delay."""
ACCUSED = 0.01
"""Chance that a device all of whose numbers lie at the edge of their tolerances is accused of anything."""
TRUSTED = {"law": 0.05, "normal": 2.0}
"""Error of the law on held-out presses, and half width of the interval of a normal (°), of a fit that is ``ok``."""
_HELD = 0.2  # part of the touches that is held out
_TAIL = 5.0  # degrees of freedom of Student's distribution of the residuals
_GAUGE = 1e8  # weight with which the mean gain is held at nought, since it is the stiffness
_LEAST = 1e-4  # share of crosstalk below which neighbours are left out of derivatives
_ROUNDS, _STEPS, _SETTLED = 6, 25, 0.01  # of noise; of the numbers, and the gain of cost at which they are settled
_CHANNELS = 60  # columns of which the noise is fitted
_SUSPECT, _DOUBTED, _TOUCH = 1.5, 3.0, 2.5
"""Standard errors by which a taxel is explained worse than the median one: to try other places; to doubt the fit."""
_NUDGES = (-3e-5, 3e-5, -1e-4, 1e-4)
"""Moves (m) of such a taxel along its normal, by which its touches begin a reading sooner or later."""
_CLEARLY = 0.1  # mean correlation by which columns must suit other taxels better than their own
_CHANCE = 0.02  # part of the readings that a wrong order of axes may explain more than the right one
_MOVES = (-2e-3, 0.0, 2e-3)  # places (m) beside its own at which a taxel that nothing else explains is tried


@dataclass(frozen=True)
class Fault:
    """Something about a device that is not as it should be."""

    kind: str
    """``order``, ``shifted``, ``turned``, ``axes``, ``gain``, ``friction``, ``delay`` or ``dead``."""
    taxel: str
    """Name of the taxel; empty for the whole device."""
    text: str


@dataclass(frozen=True, eq=False)
class DeviceFit:
    """A fitted device."""

    device: Device
    probes: Probes
    """Where the taxels are, and their normals [N]."""
    noise: Noise
    estimates: dict[str, Estimate]
    taxels: list[dict[str, Any]]
    faults: list[Fault]
    notes: list[str]
    doubts: list[str]
    """Why the fit is not to be trusted, with what would decide it; empty for one that is ``ok``."""
    held_out: float
    """Error of the law on presses that were not fitted, as a part of the readings (rms, less the noise)."""
    spread: NDArray[np.float64]
    """[P, P] covariance: shared numbers, then place, turn, gain and bias of each taxel."""

    @property
    def status(self) -> str:
        """``ok``, or ``uncertain`` where there are doubts."""
        return "uncertain" if self.doubts else "ok"

    def law(self) -> dict[str, float]:
        """Return the settings of ``KinematicTaxel``."""
        shared = self.device.shared
        stiffness = float(np.exp(shared["stiffness"]))
        law = {name: float(shared[name]) for name in ("exponent", "friction", "grip")}
        return {"stiffness": stiffness, "damping": stiffness * float(shared["damping"]), **law}

    def save(self, path: str | os.PathLike[str], link: str, **about: Any) -> None:
        """Write the noise as a preset with law and intervals beside it, and ``NAME-probes.json`` with the places."""
        self.noise.save(path, law=self.law(), estimates=self.estimates, taxels=self.taxels, faults=self.faults,
                        notes=self.notes, status=self.status, doubts=self.doubts,
                        held_out=self.held_out, **about)  # fmt: skip
        write_probes(os.fspath(path).removesuffix(".json") + "-probes.json", {link: self.probes})

    def draws(self, count: int, seed: int = 0) -> list[DeviceFit]:
        """Return devices drawn from the posterior, to randomise a simulation with."""
        rng = np.random.default_rng(seed)
        roots, axes = np.linalg.eigh(self.spread)
        fits = []
        for _ in range(count):
            step = axes @ (np.sqrt(np.maximum(roots, 0)) * rng.normal(size=len(roots)))
            device = _moved(self.device, step)
            normal = (device.turn * self.device.turn.inv()).apply(np.array(self.probes.normal))
            probes = replace(self.probes, position=device.place, normal=normal, pitch=None)
            fits.append(replace(self, device=device, probes=probes, noise=_noise_of(device, self.estimates)))
        return fits


def fit_device(presses: Presses, *, max_delay: float = 0.5, names: tuple[str, ...] = ()) -> DeviceFit:
    """Fit law, friction, damping, crosstalk, hysteresis, delay, places, normals, gains and noise of a device at once.

    The last fifth of the touches is held out. Columns of the log that stand in the order of other taxels are put right.
    """
    names = names if len(names) == len(presses.probes) else tuple(map(str, range(len(presses.probes))))
    readings, mixing = presses.readings, crosstalk_of(presses.probes)
    stuck = np.ptp(readings, axis=0).max(axis=1) == 0
    blocks = presses.stretches(presses.pressed)
    if len(blocks) < 5:
        raise DataError(f"The log holds {len(blocks)} touches of the ball; a fit of a device needs 5, and better 20.")
    cut = int(blocks[int((1 - _HELD) * len(blocks))][0])
    used = _part(presses, slice(0, cut))
    touched = used.near.any(axis=1) & ~stuck
    if not touched.any():
        raise DataError("Every taxel of the log is stuck at one value, so nothing can be fitted.")
    search = _Search(used, touched, mixing, max_delay)
    columns = search.columns(~stuck)
    if len(moved := np.flatnonzero(columns != np.arange(len(columns)))):
        log = replace(presses.log, readings=readings[:, columns].reshape(len(readings), -1), probes=())
        fit = fit_device(Presses(log, presses.probes, presses.radius), max_delay=max_delay, names=names)
        pairs = listing((f"that of {names[columns[n]]} reads what {names[n]} should" for n in moved), limit=6)
        text = f"columns of the log stand in another order than the taxels: {pairs}; the fit has put them right"
        return replace(fit, faults=[Fault("order", "", text), *fit.faults])
    search.search()
    search.device = _renamed(search.device)
    noise = search.finish()
    device, spread = search.device, search.covariance()
    faults = [Fault("dead", names[n], f"taxel {names[n]} is stuck at one value") for n in np.flatnonzero(stuck)]
    faults += _faults(device, spread, presses, touched, names)
    normal = device.turn.apply(np.array(presses.probes.normal))
    probes = replace(presses.probes, position=device.place, normal=normal, pitch=None)
    estimates, notes = _estimates(search, spread, noise)
    if mixing is None:
        notes.append("Crosstalk was not fitted: it needs taxels on a grid.")
    idle = (search.reply.felt[3] == 0).all(axis=(0, 2)) & ~stuck
    reply = answer(presses, device, mixing).readings
    rest = (readings - reply)[cut:]
    near = presses.near.T[cut:] & touched
    away = ~near & touched
    still = np.mean(rest[away] ** 2) if away.any() else search.white**2
    signal = np.mean((reply[cut:] - device.bias)[near] ** 2) if near.any() else np.nan
    held = float(np.sqrt(max(np.mean(rest[near] ** 2) - still, 0.0) / signal)) if signal > 0 else np.nan
    taxels = _rows(device, spread, presses, names)
    doubts = _doubts(search, held, taxels, idle)
    return DeviceFit(
        device, probes, _noise_of(device, estimates), estimates, taxels, faults, notes, doubts, held, spread
    )


def _part(presses: Presses, rows: slice) -> Presses:
    names = ("time", "readings", "episode", "ball")
    parts = {name: None if (a := getattr(presses.log, name)) is None else a[rows] for name in names}
    return Presses(replace(presses.log, **parts, reference=None), presses.probes, presses.radius)


def _moved(device: Device, step: NDArray[np.float64]) -> Device:
    """Return a device with steps [P] of its numbers added, within their limits."""
    g = len(SHARED)
    shared = np.clip([device.shared[name] for name in SHARED] + step[:g], *_LIMITS)
    place, turn, gain, bias = np.split(step[g:].reshape(len(device.gain), -1), [3, 6, 7], axis=1)
    return Device(dict(zip(SHARED, shared.tolist(), strict=True)), device.place + place, device.axes,
                  Rotation.from_rotvec(turn) * device.turn, device.gain + gain[:, 0], device.bias + bias)  # fmt: skip


class _Search:
    """Maximum of the posterior, by damped Gauss–Newton steps, and the noise of what is left.

    Residuals count by Student's distribution: a touch that begins one reading early or late drags a taxel by another
    way, which no derivative tells, and must not pull the others.
    """

    def __init__(self, presses: Presses, touched: NDArray, mixing: NDArray | None, max_delay: float) -> None:
        self.presses, self.touched, self.mixing = presses, touched, mixing
        self.readings = presses.readings
        count, channels = self.readings.shape[1:]
        shared = {name: prior.middle for name, prior in PRIORS.items()}
        free = ~presses.near.any(axis=0)
        bias = np.median(self.readings[free], axis=0) if free.any() else np.zeros((count, channels))
        self.device = Device(shared, presses.probes.position.copy(), presses.axes, Rotation.identity(count),
                             np.zeros(count), bias)  # fmt: skip
        expected = answer(presses, self.device, mixing).readings - bias
        size, seen = (np.linalg.norm(values, axis=2) for values in (expected, self.readings - bias))
        total, heard = size[:, touched].sum(axis=1), seen[:, touched].sum(axis=1)
        step = presses.log.step
        lags = find_delays([(total[span], heard[span, None]) for span in presses.log.spans], round(max_delay / step))
        shared["read_delay"] = sum(lags) / 2 * step
        late = Lag(presses, shared).delayed(size)
        scale = np.median((late * seen).sum(axis=0)[touched] / np.maximum((late**2).sum(axis=0)[touched], 1e-300))
        self.first = float(np.log(max(scale, 1e-300)))
        if not -11 < self.first < 30:
            raise DataError("No taxel reads more where the ball presses: check the frame of the ball and its radius.")
        shared["stiffness"] = self.first
        self.quantum = find_quantum(presses.log.readings[:, np.repeat(touched, channels)].ravel())
        self.white, self.walk = 1.0, 0.0

    def middle(self, name: str) -> float:
        """Return what is assumed of a shared number."""
        return PRIORS[name].middle + (self.first if name == "stiffness" else 0.0)

    def whitened(self, values: NDArray[np.float64], axis: int = 0) -> NDArray[np.float64]:
        """Return signals whose noise is independent and of unit size: drift and white noise are taken off."""
        if not self.walk:
            return values / self.white
        # Differences of both together are a moving average of two: its inverse is a filter (Box & Jenkins).
        ratio = 1 + 0.5 * (self.walk / self.white) ** 2
        theta = ratio - np.sqrt(ratio**2 - 1)
        values = np.moveaxis(values, axis, 0)
        parts = [lfilter([1.0, -1.0], [1.0, -theta], values[span], axis=0) for span in self.presses.log.spans]
        return np.moveaxis(np.concatenate(parts), 0, axis) * np.sqrt(theta) / self.white

    def rest(self, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return whitened residuals [T, N', C] of the taxels that were touched."""
        return self.whitened((self.readings - readings)[:, self.touched])

    def away(self, device: Device) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return how far all numbers [P] lie from what was assumed of them, and the weights [P] of that."""
        shared = [device.shared[name] - self.middle(name) for name in SHARED]
        local = np.hstack([device.place - self.presses.probes.position, device.turn.as_rotvec(), device.gain[:, None],
                           0 * device.bias])  # fmt: skip
        widths = np.r_[[PLACE] * 3, [TURN] * 3, GAIN, [BIAS * self.white] * device.bias.shape[1]]
        spreads = np.r_[[PRIORS[name].spread for name in SHARED], np.tile(widths, len(local))]
        return np.r_[shared, local.ravel()], spreads**-2.0

    def cost(self, readings: NDArray[np.float64], device: Device) -> float:
        """Return minus the logarithm of the posterior of a device that gives ``readings``."""
        offset, weight = self.away(device)
        gain = device.gain[self.touched].mean()
        rest = self.rest(readings)
        robust = 0.5 * (_TAIL + 1) * np.log1p(rest**2 / _TAIL).sum()
        return float(robust + 0.5 * (offset**2 * weight).sum() + 0.5 * _GAUGE * gain**2)

    def normal_equations(self, reply: Answer, device: Device, robust: bool = True) -> tuple[NDArray, NDArray]:
        """Return matrix [P, P] and slope [P] of the posterior; without ``robust``, of Gaussian noise."""
        g, (count, channels) = len(SHARED), self.readings.shape[1:]
        width = 7 + channels
        matrix, slope = np.zeros((g + count * width,) * 2), np.zeros(g + count * width)
        share, rest = mixed_by(device, self.mixing), self.rest(reply.readings)
        level = self.whitened(np.ones((len(self.readings), 1)))[:, 0]
        bias = level[:, None, None] * np.eye(channels)
        for number, n in enumerate(np.flatnonzero(self.touched)):
            around = np.flatnonzero((share[n] > _LEAST) & self.touched)
            felt = np.einsum("k,ptki,ci->kptc", share[n, around], reply.felt[:, :, around], reply.along[n])
            moves = np.concatenate([reply.shared[:, :, n], reply.turned[:, :, n], felt.reshape(-1, *felt.shape[2:])])
            rows = np.concatenate([self.whitened(moves, 1), bias.transpose(1, 0, 2)]).reshape(-1, rest[:, 0].size)
            start = g + n * width
            felt_at = (g + around * width)[:, None] + [0, 1, 2, 6]
            turn, levels = start + np.arange(3, 6), start + np.arange(7, width)
            at = np.r_[np.arange(g), turn, felt_at.ravel(), levels]
            error = rest[:, number].ravel()
            weight = (_TAIL + 1) / (_TAIL + error**2) if robust else np.ones_like(error)
            matrix[np.ix_(at, at)] += (rows * weight) @ rows.T
            slope[at] += rows @ (weight * error)
        if not robust:
            # Variance of an estimate by these weights over that by least squares (Huber 1981).
            influence = (_TAIL + 1) * rest / (_TAIL + rest**2)
            change = (_TAIL + 1) * (_TAIL - rest**2) / (_TAIL + rest**2) ** 2
            matrix *= np.mean(change) ** 2 / np.mean(influence**2)
        offset, weight = self.away(device)
        matrix[np.diag_indices(len(slope))] += weight
        slope -= offset * weight
        # The mean gain is the stiffness.
        gains = g + np.flatnonzero(self.touched) * width + 6
        matrix[np.ix_(gains, gains)] += _GAUGE / len(gains) ** 2
        slope[gains] -= _GAUGE * device.gain[self.touched].mean() / len(gains)
        return matrix, slope

    def descend(self) -> None:
        """Fit the numbers until the cost falls no more, for noise that is known."""
        device, damping, steady = self.device, 1e-3, False
        reply = answer(self.presses, device, self.mixing)
        cost, (matrix, slope) = self.cost(reply.readings, device), self.normal_equations(reply, device)
        for _ in range(_STEPS):
            values = np.array([device.shared[name] for name in SHARED])
            free = np.ones(len(slope), bool)
            free[len(SHARED) - 1] = not steady
            free[: len(SHARED)] &= ~((values <= _LIMITS[0]) & (slope[: len(SHARED)] < 0))
            step = np.zeros(len(slope))
            heavy = matrix + damping * np.diag(np.diag(matrix))
            step[free] = np.linalg.solve(heavy[np.ix_(free, free)], slope[free])
            expected = 0.5 * float(slope @ step)
            if expected < _SETTLED or (damping > 1 and expected < 1):
                break
            trial = _moved(device, step)
            answered = answer(self.presses, trial, self.mixing)
            gained = cost - self.cost(answered.readings, trial)
            if gained > 0:
                device, reply, cost = trial, answered, cost - gained
                if gained < _SETTLED or (damping > 1 and gained < 1):
                    break
                matrix, slope = self.normal_equations(reply, device)
                damping = max(damping / 10, 1e-9)
            elif not steady:
                # The cost has an edge at delays of whole readings, at which no step of the delay leads down.
                steady = True
            else:
                damping *= 10
        self.device, self.reply = device, reply

    def settle(self) -> None:
        """Fit numbers and noise in turn until the noise stays what it is."""
        for _ in range(_ROUNDS):
            reply = answer(self.presses, self.device, self.mixing)
            pressed = np.abs(reply.readings - self.device.bias).max(axis=2)[:, self.touched] > 0
            rest = (self.readings - reply.readings)[:, self.touched][pressed]
            # Of the median deviation; readings that are rounded to few steps may have none.
            before, self.white = self.white, float(1.4826 * np.median(np.abs(rest)) + 1e-3 * np.std(rest)) + 1e-12
            self.descend()
            if abs(before / self.white - 1) < 0.02:
                break

    def finish(self) -> dict[str, Estimate]:
        """Fit white noise and drift to what is left, and the numbers once more; return the noise."""
        estimates: dict[str, Estimate] = {}
        for _ in range(2):
            rest = (self.readings - self.reply.readings)[:, self.touched].reshape(len(self.readings), -1)[:, :_CHANNELS]
            rest = np.clip(rest, -4 * self.white, 4 * self.white)
            parts = [
                (np.zeros(len(rest[span])), rest[span], np.arange(len(rest[span]))) for span in self.presses.log.spans
            ]
            fit = fit_dynamics(parts, self.presses.log.step, self.quantum, moving=False)
            # What the fitted numbers explain of the noise is missing in the residuals.
            taxels, channels = self.readings[0, self.touched].shape
            freed = 1 - (len(SHARED) + taxels * (7 + channels)) / (len(self.readings) * taxels * channels)
            white, more = fit.estimates["white"], max(freed, 0.1) ** -0.5
            white = Estimate(more * white.value, more * white.low, more * white.high, white.how)
            estimates = {"white": white, "walk": fit.estimates["walk"]}
            self.white, self.walk = fit.dynamics.white, fit.dynamics.walk if estimates["walk"].value else 0.0
            self.descend()
        return estimates

    def covariance(self) -> NDArray[np.float64]:
        """Return that of all numbers [P, P]."""
        return np.linalg.inv(self.normal_equations(self.reply, self.device, robust=False)[0])

    def columns(self, living: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the column [N] of the log that reads what each taxel should, which is its own where that is unclear.

        A ball touches the taxels one after the other, so the course of a column says whose it is.
        """
        seen = np.linalg.norm(self.readings - np.median(self.readings, axis=0), axis=2)
        due = np.linalg.norm(readings_of(self.presses, self.device, self.mixing) - self.device.bias, axis=2)
        reached = due.any(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            alike = np.corrcoef(seen.T, due.T)[: len(living), len(living) :]
        alike = np.where(living[:, None] & reached, np.nan_to_num(alike), 0.0)
        columns, taxels = linear_sum_assignment(-alike)
        order = columns[np.argsort(taxels)]
        order[~reached] = np.setdiff1d(columns, order[reached])
        gains = alike[order, np.arange(len(order))] - np.diag(alike)
        moved = reached & (order != np.arange(len(order)))
        return order if gains[moved].sum() > _CLEARLY * moved.sum() else np.arange(len(order))

    def straightened(self, device: Device, suspects: NDArray[np.int64]) -> Device:
        """Return a device with the order and sense of axes and the place of suspects that explain them best."""
        nominal = self.presses.axes
        moves = np.array([*itertools.product(_MOVES, repeat=3)])
        turn = device.turn.as_matrix()
        turn[suspects] = np.eye(3)
        upright = replace(device, turn=Rotation.from_matrix(turn), axes=np.tile(np.eye(3), (len(turn), 1, 1)))
        places = np.tile(device.place, (len(moves), 1, 1))
        places[:, suspects] = (self.presses.probes.position + moves[:, None])[:, suspects]
        orders = np.einsum("oij,njk->onik", _orders(nominal.shape[1]), nominal)
        seen = self.readings - device.bias
        scores, gains = np.zeros((2, len(moves), len(orders), len(turn)))
        for index, place in enumerate(places):
            trial = replace(upright, place=place, bias=np.zeros((len(turn), 3)))
            signal = readings_of(self.presses, trial, self.mixing)
            match = np.einsum("onci,nci->on", orders, np.einsum("tnc,tni->nci", seen, signal))
            power = np.einsum("onci,onck,nik->on", orders, orders, np.einsum("tni,tnk->nik", signal, signal))
            gains[index] = match / np.maximum(power, 1e-300)
            scores[index] = np.maximum(match, 0) * gains[index]
        # Another order must explain more than the right one by what chance may do.
        scores[:, 0] += _CHANCE * (seen**2).sum(axis=(0, 2))
        axes, place, gain = device.axes.copy(), device.place.copy(), device.gain.copy()
        for n in suspects:
            index, order = np.unravel_index(int(scores[:, :, n].argmax()), scores.shape[:2])
            axes[n], place[n] = orders[order, n], places[index, n]
            gain[n] += np.log(np.clip(gains[index, order, n], 0.2, 5.0))
        change = gain[self.touched].mean()
        gain[self.touched] -= change
        shared = device.shared | {"stiffness": device.shared["stiffness"] + change}
        return Device(shared, place, axes, upright.turn, gain, device.bias)

    def search(self) -> None:
        """Fit everything, then from other places of the taxels that are explained badly."""
        first = self.device
        self.settle()
        step, late = self.presses.log.step, self.device.shared["read_delay"]
        if (whole := step * round(late / step)) != late:
            self.attempt(replace(self.device, shared=self.device.shared | {"read_delay": whole}))
        seen, rest = ((self.readings - values)[:, self.touched] for values in (self.device.bias, self.reply.readings))
        if np.linalg.norm(rest) > TRUSTED["law"] * np.linalg.norm(seen):
            # Where all are wrong alike, none is explained worse than the others, and the law is bent to fit them.
            self.attempt(self.straightened(first, np.flatnonzero(self.touched)))
        for nudge in (0.0, *_NUDGES):
            if not len(suspects := self.suspects(_SUSPECT)):
                break
            place = self.device.place.copy()
            place[suspects] += nudge * np.array(self.presses.probes.normal)[suspects]
            self.attempt(replace(self.device, place=place) if nudge else self.straightened(self.device, suspects))

    def suspects(self, sure: float) -> NDArray[np.int64]:
        """Return the taxels that are explained worse than the median one by ``sure`` standard errors, or worse in one
        touch by :data:`_TOUCH` more."""
        cost = np.log1p(self.rest(self.reply.readings) ** 2 / _TAIL).mean(axis=2)
        level, chance = float(np.median(cost.mean(axis=0))), float(np.median(cost.std(axis=0)))
        worse = cost.mean(axis=0) - level > sure * chance / np.sqrt(len(cost))
        numbers = np.flatnonzero(self.touched)
        for number, n in enumerate(numbers):
            for rows in self.presses.stretches(self.presses.near[n]):
                worse[number] |= cost[rows, number].mean() - level > (sure + _TOUCH) * chance / np.sqrt(len(rows))
        return numbers[worse]

    def attempt(self, start: Device) -> None:
        """Fit from another start, and return to the present device if that explains more."""
        device, levels = self.device, [self.white]
        self.device = start
        self.settle()
        levels.append(self.white)
        self.white = min(levels)
        costs = [self.cost(readings_of(self.presses, each, self.mixing), each) for each in (device, self.device)]
        self.white = levels[int(costs[1] <= costs[0])]
        if costs[0] < costs[1]:
            self.device, self.reply = device, answer(self.presses, device, self.mixing)


def _orders(channels: int) -> NDArray[np.float64]:
    """Return the orders and senses [O, C, C] that axes may have, the right one first."""
    signs = itertools.product((1.0, -1.0), repeat=channels)
    orders = itertools.product(signs, itertools.permutations(np.eye(channels)))
    return np.array([np.array(rows) * sign for sign, rows in orders])


def _renamed(device: Device) -> Device:
    """Return the same device, but a taxel that is turned by more than half a right angle has swapped axes."""
    whole = turned_axes(device)
    if whole.shape[1] == 1:
        return device
    orders = _orders(3)
    same = np.multiply.outer(np.linalg.det(whole), np.linalg.det(orders)) > 0
    axes = orders[np.where(same, np.einsum("oij,nij->no", orders, whole), -np.inf).argmax(axis=1)]
    return replace(device, axes=axes, turn=Rotation.from_matrix(whole.swapaxes(1, 2) @ axes))


def _errors(device: Device, spread: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """Return standard errors [G] and [N, 7 + C]; turns about the one axis along which a taxel reads do not count."""
    error, g = np.sqrt(np.maximum(np.diag(spread), 0)), len(SHARED)
    local = error[g:].reshape(len(device.place), -1)
    if device.bias.shape[1] == 1:
        for n, (axis,) in enumerate(turned_axes(device)):
            start = g + n * local.shape[1] + 3
            across = np.cross(axis, np.eye(3))
            local[n, 3:6] = np.sqrt(np.diag(across @ spread[start : start + 3, start : start + 3] @ across.T))
    return error[:g], local


def _estimates(search: _Search, spread: NDArray, noise: dict[str, Estimate]) -> tuple[dict[str, Estimate], list[str]]:
    """Return the shared numbers and the noise with intervals, and words for those that cannot be told."""
    device = search.device
    errors, _ = _errors(device, spread)
    estimates, notes = {}, []
    for index, (name, error) in enumerate(zip(SHARED, errors, strict=True)):
        prior = PRIORS[name]
        value, ends = device.shared[name], (device.shared[name] - Z95 * error, device.shared[name] + Z95 * error)
        low, high = (float(np.clip(end, prior.low, prior.high)) for end in ends)
        if name in ("stiffness", "hysteresis_tau"):
            value, low, high = (float(np.exp(number)) for number in (value, low, high))
        if name == "damping":
            scale = float(np.exp(device.shared["stiffness"]))
            # c = k η: errors of both, which move together.
            change = np.array([value, 1.0]) * scale
            block = spread[np.ix_([0, index], [0, index])]
            half = Z95 * float(np.sqrt(change @ block @ change))
            value, low, high = scale * value, max(scale * value - half, 0.0), scale * value + half
        how = "joint fit of all presses"
        if error > UNTOLD * prior.spread:
            how = "not told by this log"
            notes.append(f"{name} cannot be told: {prior.remedy}.")
        estimates[name] = Estimate(float(value), low, high, how)
    bias, quantum = device.bias[search.touched], search.quantum
    mean = np.zeros((len(device.place), 7 + bias.shape[1]))
    mean[search.touched, 7:] = 1 / bias.size
    mean = np.r_[np.zeros(len(SHARED)), mean.ravel()]
    half = Z95 * float(np.sqrt(mean @ spread @ mean))
    middle = float(bias.mean())
    estimates |= noise | {
        "quantum": Estimate(quantum, quantum, quantum, "all readings are its multiples" if quantum else "none found"),
        "bias": Estimate(middle, middle - half, middle + half, "mean of the taxels"),
    }
    return estimates, notes


def _rows(device: Device, spread: NDArray, presses: Presses, names: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return place, normal and gain of each taxel with the half widths of their 95 % intervals; of a normal, the
    half angle of a cone."""
    _, local = _errors(device, spread)
    normal = device.turn.apply(np.array(presses.probes.normal))
    blocks = len(SHARED) + local.shape[1] * np.arange(len(names))[:, None] + [3, 4, 5]
    # A turn about the normal itself does not tilt it.
    across = np.cross(normal[:, None], np.eye(3))
    tilts = across @ spread[blocks[:, :, None], blocks[:, None]] @ across.swapaxes(1, 2)
    circle = np.degrees(np.sqrt(chi2.ppf(0.95, 2) * np.maximum(np.linalg.eigvalsh(tilts)[:, -1], 0)))
    tilt = np.degrees(np.arccos(np.clip((normal * presses.probes.normal).sum(axis=1), -1, 1)))
    return [
        {
            "taxel": names[n], "place": device.place[n], "place_error": Z95 * local[n, :3],
            "shift": float(np.linalg.norm(device.place[n] - presses.probes.position[n])), "normal": normal[n],
            "normal_error": float(circle[n]), "tilt": float(tilt[n]),
            "gain": float(np.exp(device.gain[n])), "gain_error": float(Z95 * local[n, 6]),
        }
        for n in range(len(names))
    ]  # fmt: skip


def _doubts(search: _Search, held: float, taxels: list[dict[str, Any]], idle: NDArray[np.bool_]) -> list[str]:
    """Say why a fit is not to be trusted, and which presses would decide it."""
    doubts: list[str] = []
    if not held <= TRUSTED["law"]:
        size = "no taxel was touched" if np.isnan(held) else f"the law errs by {held:.1%}"
        remedy = "log more presses, or check the clock, the frame of the ball and the order of taxels"
        doubts.append(f"On the presses that were held out {size} (at most {TRUSTED['law']:.0%}): {remedy}.")
    if idle.any():
        untouched = listing(taxels[n]["taxel"] for n in np.flatnonzero(idle))
        doubts.append(f"Never touched, and left where they should be: {untouched}; press there.")
    wide = [n for n in np.flatnonzero(search.touched & ~idle) if taxels[n]["normal_error"] > TRUSTED["normal"]]
    doubts += [
        f"The normal of taxel {row['taxel']} is told to ± {row['normal_error']:.1f}° only (at most "
        f"{TRUSTED['normal']:g}°): press it more, and let the ball slide."
        for row in (taxels[n] for n in wide)
    ]
    sizes = np.full(len(taxels), np.nan)
    sizes[search.touched] = np.sqrt(np.mean(search.rest(search.reply.readings) ** 2, axis=(0, 2)))
    doubts += [
        f"Taxel {taxels[n]['taxel']} is explained worse than the others (to {sizes[n]:.2f} times the noise) by more "
        "than chance: its numbers may be wrong; press it more."
        for n in search.suspects(_DOUBTED)
    ]
    return doubts


def _faults(device: Device, spread: NDArray, presses: Presses, touched: NDArray, names: tuple[str, ...]) -> list[Fault]:
    """Name the numbers that lie beyond their tolerance for certain."""
    errors, local = _errors(device, spread)
    # Standard errors beyond a tolerance, corrected for the number of comparisons.
    sure = float(norm.isf(ACCUSED / (3 * touched.sum() + 2)))
    faults = []
    wrong = np.flatnonzero((device.axes != presses.axes).any(axis=(1, 2)))
    alike = 1 < touched.sum() == len(wrong) and bool((device.axes[wrong] == device.axes[wrong[0]]).all())
    for n in wrong[:1] if alike else wrong:
        who, ending = ("all taxels", "") if alike else (f"taxel {names[n]}", "s")
        text = f"{who} fall{ending} where the ball presses"
        if device.axes.shape[1] == 3:
            words = ["-"[: int(row.sum() < 0)] + "xyz"[int(np.abs(row).argmax())] for row in device.axes[n]]
            text = f"{who} give{ending} {', '.join(words)} where x, y, z belong"
        faults.append(Fault("axes", "" if alike else names[n], text))
    shift = device.place - presses.probes.position
    common = np.median(shift[touched], axis=0)
    if (far := float(np.linalg.norm(common))) > TOLERANCES["place"]:
        faults.append(Fault("shifted", "", f"all taxels lie {1e3 * far:.2g} mm beside their places: the frame of the "
                                           "ball is shifted"))  # fmt: skip
    middle = float(np.median(device.gain[touched]))
    turn = device.turn.as_rotvec()
    for n in np.flatnonzero(touched):
        away = float(np.linalg.norm(shift[n] - common))
        if away - sure * float(local[n, :3].max()) > TOLERANCES["place"]:
            faults.append(Fault("shifted", names[n], f"taxel {names[n]} lies {1e3 * away:.2g} mm beside its place"))
        angle = float(np.linalg.norm(turn[n]))
        if angle - sure * float(local[n, 3:6].max()) > TOLERANCES["turn"]:
            faults.append(Fault("turned", names[n], f"taxel {names[n]} is turned by {np.degrees(angle):.2g}°"))
        gain = float(device.gain[n]) - middle
        if abs(gain) - sure * float(local[n, 6]) > TOLERANCES["gain"]:
            faults.append(Fault("gain", names[n], f"taxel {names[n]} reads {np.exp(gain):.2g} times what it should"))
    at = {name: index for index, name in enumerate(SHARED)}
    if device.shared["friction"] + sure * errors[at["friction"]] < TOLERANCES["friction"]:
        faults.append(Fault("friction", "", "no friction, although the ball slides"))
    delay, step = device.shared["read_delay"], presses.log.step
    if delay - sure * errors[at["read_delay"]] > TOLERANCES["delay"] * step:
        faults.append(Fault("delay", "", f"readings come {delay:.3g} s after the ball"))
    return faults


def _noise_of(device: Device, estimates: dict[str, Estimate]) -> Noise:
    """Return the noise of a device: its gains are a range of depths' factors."""
    gains, shared = np.exp(device.gain / device.shared["exponent"]), device.shared
    return Noise(
        gain=(float(gains.min()), float(gains.max())), hysteresis_tau=float(np.exp(shared["hysteresis_tau"])),
        hysteresis=shared["hysteresis"], read_delay=shared["read_delay"], crosstalk=shared["crosstalk"],
        white=estimates["white"].value, walk=estimates["walk"].value, quantum=estimates["quantum"].value,
        bias=estimates["bias"].value,
    )  # fmt: skip
