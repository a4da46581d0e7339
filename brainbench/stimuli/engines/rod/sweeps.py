"""Many passive sweeps in one launch: no scene, job or trace per sweep, a few numbers each.

The object's surface is uploaded once and scaled, turned and moved inside the kernel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from itertools import groupby
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import pick_device
from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation, euler_matrix, from_matrices
from brainbench.stimuli.engines.error_estimates import HALF_STEP, MORE_LINKS, changes, halved_step, lateness, more_links
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.protocol import PassiveSweeps, SweepBatch, describe_unstable, join_batches
from brainbench.stimuli.engines.rod.launch import (
    Approach,
    Launch,
    LaunchResult,
    Try,
    WhiskerSolver,
    followed,
    run_with_retries,
)
from brainbench.stimuli.engines.rod.limits import MESHES
from brainbench.stimuli.engines.rod.packing import (
    KNOT,
    PackedJobs,
    PackedMotions,
    PackedShapes,
    PackedSurface,
    still_knots,
)
from brainbench.stimuli.engines.trust import BLOW
from brainbench.stimuli.motion.jobs import MILLI
from brainbench.stimuli.objects.solid import Solid

BLOCK = 64  # threads of one block on a GPU
BOUNDS = (BLOCK, 8)
"""CUDA launch bounds: registers are spilled for twice as many threads at a time (benchmarks/RESULTS.md)."""
SLICED_BOUNDS = (BLOCK, 4)  # the same for whiskers in slices, whose registers are needed more than further threads


@lru_cache(maxsize=1)
def _helpers() -> ThreadPoolExecutor:
    """Return threads that stay, since each has streams of its own on a GPU."""
    return ThreadPoolExecutor(64)


class SweepLauncher:
    """The whiskers of a grid of sweeps on a device, ready for any number of sweeps."""

    def __init__(
        self,
        scenes: PassiveSweeps,
        fidelity: Fidelity,
        device: str = "cpu",
        sliced: bool | None = None,
        packed: Mapping[str, tuple[float, PackedSurface]] | None = None,
    ) -> None:
        grid = scenes.grid
        if grid.mover != "object":
            raise UsageError("Only sweeps whose object moves go through the fast path; received mover='head'.")
        self.device = pick_device(device)
        sliced = bool(self.device.is_cuda) if sliced is None else sliced
        bounds = SLICED_BOUNDS if sliced else BOUNDS
        self.scenes, self.grid = scenes, grid
        self.spacing = float(np.median(np.diff(grid.frames.readings, prepend=0.0)))
        mounts = list(scenes.array)
        self.whiskers = [mount.whisker for mount in mounts]
        self._solver_of = partial(
            WhiskerSolver, device=self.device, needs=MESHES, block=BLOCK, sliced=sliced, bounds=bounds
        )
        self._left_open = fidelity.contact_line is None
        self.fidelity = fidelity = fidelity.touching(scenes.objects)
        self.solver = self._solver_of([fidelity.chain(whisker) for whisker in self.whiskers], fidelity)
        self._head = grid.head.matrix
        self._origin = np.asarray(grid.head.position)
        self._packed = packed or {}
        self._lock, self._sliced = Lock(), sliced
        self._objects: dict[str, tuple[float, PackedSurface]] = {}
        angles = base_rotation([mount.angles for mount in mounts])
        frames = zip(mounts, from_matrices(angles), strict=True)
        self._bases = [still_knots(np.asarray(mount.position), quaternion) for mount, quaternion in frames]
        # Steps between readings, rounded as the kernel rounds them.
        spans = np.diff(grid.frames.readings * MILLI, prepend=0.0)
        steps = self.solver.steps
        self.steps_in_full = sum(int(np.ceil(spans / step - 1e-3).clip(1).sum()) for step in steps)
        """Steps that the whiskers of one sweep take from start to end."""

    def free(self) -> None:
        """Give back what is on the device; no launch may follow."""
        for solver in (self.solver, *(solver for _, solver in vars(self).get("finer", ()))):
            solver.free()
        if "on_links" in vars(self):
            self.on_links.free()

    @cached_property
    def finer(self) -> list[tuple[float, WhiskerSolver]]:
        """Solvers whose forces tell the error (:mod:`..error_estimates`), and what their changes are multiplied by."""
        least = min(self.whiskers, key=lambda whisker: whisker.damping_ratio)
        half, chains = halved_step(self.fidelity, least, self.spacing), self.solver.chains
        longer = [more_links(self.fidelity, whisker).chain(whisker) for whisker in self.whiskers]
        return [(HALF_STEP, self._solver_of(chains, half)), (MORE_LINKS, self._solver_of(longer, self.fidelity))]

    @cached_property
    def on_links(self) -> SweepLauncher:
        """The same whiskers on straight links, the last resort of those that are unstable on the bent rod."""
        fidelity = replace(self.fidelity, contact_line="links")
        return SweepLauncher(self.scenes, fidelity, str(self.device), self._sliced, self._packed)

    def launch(
        self,
        objects: Sequence[tuple[str, Sequence[Any]]],
        tries: Sequence[tuple[NDArray[np.bool_], int]] = (),
        solver: WhiskerSolver | None = None,
    ) -> LaunchResult:
        """Simulate sweeps, object by object: all whiskers, [sweep, whisker], or some of them, one a row.

        Args:
            objects: (name, its sweeps) in order.
            tries: which whiskers [sweep, whisker] and what divides their time steps. Rows of the result are those of
                the first try in their order, then those of the next.
            solver: one of :attr:`finer`, or the usual one.
        """
        solver = solver or self.solver
        motions, shapes = PackedMotions(), PackedShapes()
        bases = motions.add_straight(np.concatenate(self._bases))
        prepared = self._prepare([name for name, _ in objects])
        for name, sweeps in objects:
            if len(sweeps):
                self._add(shapes, motions, *prepared[name], sweeps)
        count, whiskers = len(shapes.first) - 1, len(bases)
        speed = np.array([sweep.speed for _, sweeps in objects for sweep in sweeps])
        if tries:
            sweep, whisker = np.concatenate([which.nonzero() for which, _ in tries], axis=1, dtype=np.int32)
            finer = np.repeat([divisor for _, divisor in tries], [which.sum() for which, _ in tries])
            row, column = np.arange(len(sweep), dtype=np.int32), np.zeros_like(sweep)
            size = len(sweep), 1
        else:
            # Neighbouring threads take the same whisker past the same object.
            whisker, sweep = np.indices((whiskers, count), dtype=np.int32).reshape(2, -1)
            row, column, finer, size = sweep, whisker, np.ones_like(sweep), (count, whiskers)
        radii = np.array([chain.whisker.base_radius for chain in solver.chains])
        speeds = speed[sweep]
        way, farthest = followed(speeds, speeds, solver.steps[whisker] / MILLI, radii[whisker])
        numbers = way, farthest, np.where(way > farthest, 0.0, np.inf), speeds > BLOW
        approach = Approach(*(np.empty(size, dtype=values.dtype) for values in numbers))
        for whole, values in zip(vars(approach).values(), numbers, strict=True):
            whole[row, column] = values
        jobs = PackedJobs(whisker, sweep, bases[whisker], row, column, finer)
        readings = self.grid.frames.readings
        return solver.launch(Launch(jobs, motions, shapes, readings, size, axes=self._head, approach=approach))

    def batch(self, result: LaunchResult) -> SweepBatch:
        """Return a result as frames in the form of data generation."""
        frames = self.grid.frames
        wrench, contact = result.wrench, np.greater_equal(result.contact, 0)
        if frames.average > 1 or frames.lowpass is not None:
            moved = np.moveaxis(wrench, 1, 0)
            wrench = np.moveaxis(frames.reduce(moved.astype(float)), 0, 1).astype(np.float32)
            contact = np.asarray(frames.split(np.moveaxis(contact, 1, 0)).any(axis=1)).swapaxes(0, 1)
        unstable = result.verdict.unstable
        row, whisker = np.nonzero(unstable)
        wrench[row, :, whisker] = np.nan
        return SweepBatch(
            wrench=wrench.astype(np.float32, copy=False),
            contact=contact.mean(axis=1).astype(np.float32),
            unstable=unstable,
            reasons=describe_unstable(self.scenes.array.names, unstable, result.verdict.reasons),
            steps=int(result.steps.sum()),
            steps_in_full=self.steps_in_full * len(unstable),
            retried=int((result.divisor > 1).any(axis=1).sum()),
            unsolved=int(result.counts["unsolved"].sum()),
        )

    def trusted(
        self, objects: Sequence[tuple[str, Sequence[Any]]], retry: int, estimated: NDArray[np.bool_] | None = None
    ) -> SweepBatch:
        """Simulate sweeps as :meth:`launch` takes them, and whiskers that cannot be trusted again with finer steps.

        Where nobody asked for a line of contacts, those that stay unstable are simulated on straight links.
        ``estimated`` [sweep] says whose whiskers get an error.
        """
        result = self._retried(objects, retry)
        straight = result.verdict.unstable & (self._left_open and retry > 1)
        if straight.any():
            with self._lock:
                launcher = self.on_links
            finer = launcher._retried(objects, retry, straight)
            sound = ~finer.verdict.unstable[:, 0]
            straight[straight] = sound
            result = result.replaced(straight, finer.picked(sound))
        batch = replace(self.batch(result), straight=straight)
        if estimated is None:
            return batch
        which = estimated[:, None] & ~result.verdict.unstable
        error = self._errors(objects, result, which & ~straight)
        if straight.any():
            error[straight] = self.on_links._errors(objects, result, which & straight)[straight]
        return replace(batch, error=error)

    def _retried(
        self, objects: Sequence[tuple[str, Sequence[Any]]], retry: int, which: NDArray[np.bool_] | None = None
    ) -> LaunchResult:
        """Simulate sweeps, or some of their whiskers [sweep, whisker], and again with finer steps what needs these."""

        def _launch(tries: Sequence[Try]) -> list[LaunchResult]:
            some = [(mask, finer) for mask, finer in tries if mask is not None]
            if which is not None:
                whole = [(which.copy(), finer) for _, finer in tries]
                for (part, _), (mask, _) in zip(whole, tries, strict=True):
                    part[which] = True if mask is None else mask[:, 0]
                some = whole
            result = self.launch(objects, some)
            return result.split([int(mask.sum()) for mask, _ in some] or [len(result.wrench)])

        return run_with_retries(_launch, retry)

    def _errors(
        self, objects: Sequence[tuple[str, Sequence[Any]]], result: LaunchResult, which: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """Return the errors of some whiskers (``which`` [sweep, whisker]), NaN of the others.

        A whisker that felt nothing has none: its base stands still. Finer runs divide their steps as the run did that
        they are compared with, by twice that where they cannot be trusted: few whiskers take a GPU long.
        """
        error = np.where(which, 0.0, np.nan).astype(np.float32)
        which = which & (result.wrench != 0).any(axis=(1, 3))
        row, whisker = np.nonzero(which)
        if not len(row):
            return error
        values, contact = result.wrench[row, :, whisker], result.contact[row, :, whisker] >= 0
        lengths = np.array([one.arc_length for one in self.whiskers])[whisker]

        def square(factor: float, solver: WhiskerSolver, shift: NDArray[np.float64] | float) -> NDArray[np.float64]:
            """Return the squared error [whisker] by a finer solver, infinite where that run is unstable too."""

            def _launch(divisors: NDArray[np.integer]) -> LaunchResult:
                whole = np.zeros_like(result.divisor)
                whole[which] = divisors
                tries = [(whole == divisor, int(divisor)) for divisor in np.unique(divisors[divisors > 0])]
                order = np.argsort(np.concatenate([np.flatnonzero(mask) for mask, _ in tries]))
                return self.launch(objects, tries, solver).picked(order)

            divisors = result.divisor[which]
            finer = _launch(divisors)
            left = finer.verdict.retryable.copy()
            if left.any():
                finer = finer.replaced(left, _launch(np.where(left[:, 0], 2 * divisors, 0)))
            change = changes(values, finer.wrench[:, :, 0], contact | (finer.contact[:, :, 0] >= 0), lengths, shift)
            return np.where(finer.verdict.unstable[:, 0], np.inf, factor * change) ** 2

        # A GPU simulates both at the same time.
        half, longer = self.finer
        shift = np.array([lateness(self.fidelity, one, self.spacing) for one in self.whiskers])[whisker]
        if self.device.is_cuda:
            coming = _helpers().submit(square, *longer, 0.0)
            squares = square(*half, shift) + coming.result()
        else:
            squares = square(*half, shift) + square(*longer, 0.0)
        error[which] = np.sqrt(squares)
        return error

    def run(
        self, indices: Sequence[int], retry: int, workers: int, estimated: NDArray[np.bool_] | None = None
    ) -> SweepBatch:
        """Simulate sweeps of the grid; on a processor ``workers`` threads each take one object at a time.

        ``estimated`` is as in :meth:`trusted`.
        """
        # Thousands of sweeps fill a GPU; small groups let the threads of a processor end together.
        limit = 4096 if self.device.is_cuda else 4
        groups: list[tuple[str, list[Any]]] = []
        count = self.grid.count
        for which, some in groupby(indices, lambda index: index // count):
            name = self.scenes.objects[which]
            every = self.grid.sweeps(name)
            sweeps = [every[index % count] for index in some]
            groups += [(name, sweeps[first : first + limit]) for first in range(0, len(sweeps), limit)]
        if self.device.is_cuda or estimated is None or not estimated.any():
            masks = [None] * len(groups)
        else:
            # Threads share the solvers, so that one makes them.
            _ = self.finer
            masks = np.split(estimated, np.cumsum([len(sweeps) for _, sweeps in groups])[:-1])
        if self.device.is_cuda:
            return self.trusted(groups, retry, estimated)
        with ThreadPoolExecutor(max_workers=workers) as pool:
            return join_batches(list(pool.map(lambda group, mask: self.trusted([group], retry, mask), groups, masks)))

    def _prepare(self, names: Sequence[str]) -> dict[str, tuple[float, PackedSurface]]:
        """Return objects as :func:`pack_object` packs them.

        Those of the last launch are kept: whiskers are simulated again, and large objects come in several launches.
        """
        # Launches may run side by side.
        packed = {**self._objects, **self._packed}
        self._objects = {
            name: packed.get(name) or pack_object(self.scenes.solid(name)) for name in dict.fromkeys(names)
        }
        return {**packed, **self._objects}

    def _add(
        self, shapes: PackedShapes, motions: PackedMotions, diagonal: float, surface: PackedSurface, sweeps: Sequence
    ) -> None:
        """Append the scenes of one object's sweeps, expressed in the frame of the array.

        Numbers are the same whatever sweeps come together: sums of products are written out, term by term.
        """
        grid, head = self.grid, self._head
        rotations = sorted({sweep.rotation for sweep in sweeps})
        about_z = np.array([euler_matrix((0.0, 0.0, rotation)) for rotation in rotations])
        # Turned about z: how far it then reaches along x and y.
        x, y = surface.outline.T
        # The lowest corner of the outline's convex hull is that of the whole surface.
        low = np.stack([(about_z[:, k, 0, None] * x + about_z[:, k, 1, None] * y).min(axis=1) for k in (0, 1)], axis=1)
        quaternion = from_matrices(head.T @ about_z)
        which = np.searchsorted(rotations, [sweep.rotation for sweep in sweeps])
        speed, height, distance, size = (
            np.array([getattr(sweep, name) for sweep in sweeps]) for name in ("speed", "height", "distance", "size")
        )
        # Objects are scaled to a diagonal and then shifted by how far the turned outline reaches, so that distances
        # count from the surface.
        scale = size / diagonal
        reach = low[which] * (scale / MILLI)[:, None]
        side = grid.start - reach[:, 1] if grid.placing == "clear" else grid.start + reach[:, 1]
        place = np.stack([distance - reach[:, 0], side, height], axis=1) - self._origin
        knots = np.zeros(len(sweeps), dtype=KNOT)
        for k in range(3):
            knots["place"][:, k] = (
                place[:, 0] * head[0, k] + place[:, 1] * head[1, k] + place[:, 2] * head[2, k]
            ) * MILLI
            # The world velocity (0, −v, 0) in the axes of the array; m/s are mm/ms.
            knots["velocity"][:, k] = -speed * head[1, k]
        knots["quaternion"] = quaternion[which]
        still = np.tile([1.0, 0.0, 0.0, 0.0], (len(sweeps), 1))
        radius, track = surface.radius * scale, motions.add_straight(knots)
        shapes.add_placed(surface, track=track, quaternion=still, scale=scale, radius=radius, speed=speed)


def pack_object(solid: Solid) -> tuple[float, PackedSurface]:
    """Return the diagonal (m) and the surface (mm) of an object; one without an exact surface is a UsageError."""
    if solid.surface is None:
        raise UsageError(f"The object {solid.name!r} has no exact surface to sweep over; use the backend 'mujoco'.")
    return solid.diagonal, PackedSurface.of(solid.surface.vertices * MILLI, solid.surface.faces)
