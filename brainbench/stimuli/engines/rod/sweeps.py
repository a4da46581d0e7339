"""Many passive sweeps in one launch: no scene, job or trace per sweep, a few numbers each.

The object's surface is uploaded once and scaled, turned and moved inside the kernel.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.devices import pick_device, to_struct, warp
from brainbench.core.errors import UsageError
from brainbench.stimuli.engines.rod.compilation import load_kernels
from brainbench.stimuli.engines.rod.limits import BENT, CROWDED, DOUBTFUL, MESHES, OK, finer_steps
from brainbench.stimuli.engines.rod.packing import (
    Chains,
    Shapes,
    Surface,
    Tracks,
    capacity_for,
    quaternions,
    still_knots,
)
from brainbench.stimuli.engines.rod.scheduling import Slices, make_problems
from brainbench.stimuli.engines.trust import MILLI
from brainbench.stimuli.objects.placement import euler_matrix
from brainbench.stimuli.whiskers.chain import build_chain

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brainbench.stimuli.engines.fidelity import Fidelity
    from brainbench.stimuli.objects.obstacle import TriangleMesh
    from brainbench.stimuli.sweeps.grid import SweepGrid
    from brainbench.stimuli.sweeps.simulation import SweepBatch
    from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes


@dataclass(frozen=True, eq=False)
class SweepResult:
    """What a launch gave, still on the device."""

    wrench: Any
    """Warp array [sweep, reading, whisker, 6] (N, N m; world axes)."""
    contact: Any
    """Warp array [sweep, reading, whisker] arc of the contact (m), negative without."""
    status: NDArray[np.int32]
    """[sweep, whisker] as :data:`brainbench.stimuli.engines.rod.limits.OK` and its neighbours."""
    steps: NDArray[np.int32]
    """[sweep, whisker] steps computed."""
    touching: NDArray[np.int32]
    """[sweep, whisker] steps with contact."""
    unsolved: NDArray[np.int32]
    """[sweep, whisker] steps whose contact forces did not converge."""
    crowded: NDArray[np.int32]
    """[sweep, whisker] steps for some of whose contacts there was no room."""
    depth: NDArray[np.floating]
    """[sweep, whisker] deepest overlap (mm)."""
    doubt: NDArray[np.floating]
    """[sweep, whisker] how much the last iterations still changed the contact forces, of their root mean square."""
    steps_in_full: int
    """Steps that every whisker takes from start to end."""

    @property
    def unstable(self) -> NDArray[np.bool_]:
        """[sweep, whisker] whose wrench cannot be trusted."""
        return (self.status != OK) | self._full | ~(self.doubt <= DOUBTFUL)

    @property
    def _full(self) -> NDArray[np.bool_]:
        """[sweep, whisker] with too many steps for some of whose contacts there was no room."""
        return self.crowded > CROWDED * np.maximum(self.steps, 1)

    def reason(self, sweep: int, whisker: int) -> str:
        """Why the wrench of a whisker cannot be trusted, in a few words."""
        if self.status[sweep, whisker] != OK:
            return "a joint bent too far" if self.status[sweep, whisker] == BENT else "a value is no number"
        if self._full[sweep, whisker]:
            return "more contacts than are solved together"
        return "contact forces not converged"


class SweepLauncher:
    """The whiskers of a grid of sweeps on a device, ready for any number of sweeps.

    Raises:
        UsageError: the head of the grid moves, or the device is unknown.
    """

    def __init__(
        self,
        scenes: SweepScenes,
        fidelity: Fidelity,
        device: str = "cpu",
        against: int | None = None,
        bounds: tuple[int, int] | None = None,
        sliced: bool | None = None,
    ) -> None:
        against = MESHES if against is None else against

        grid = scenes.grid
        if grid.mover != "object":
            raise UsageError("Only sweeps whose object moves go through the fast path; received mover='head'.")
        wp = warp()
        self.device = pick_device(device)
        self.sliced = against == MESHES and self.device.is_cuda if sliced is None else sliced
        self.slices = 0
        self.tuning: dict[str, Any] = {}
        """Arguments of :class:`Slices`."""
        self.scenes, self.grid, self.fidelity = scenes, grid, fidelity
        self.seconds: dict[str, float] = {}
        """What the last launch spent on placing objects, uploading, and computing."""
        self.quasistatic = fidelity.solver == "quasistatic"
        self._head = grid.head.matrix
        self._origin = np.asarray(grid.head.position)
        mounts = list(scenes.array)
        chains = [build_chain(m.whisker, fidelity.link_count(m.whisker.arc_length)) for m in mounts]
        self.capacity = capacity_for(max(chain.links for chain in chains))
        self.real = wp.float32 if fidelity.precision == "single" else wp.float64
        bounds = bounds or (SLICED_BOUNDS if self.sliced else BOUNDS)
        self.kernels = load_kernels(self.device, self.real, self.capacity, against, bounds=bounds, sliced=self.sliced)
        self._chains = to_struct(
            self.kernels.structs.ChainArrays, Chains(self.capacity, chains, self.quasistatic).arrays(), self.device
        )
        self.steps = np.array([fidelity.step(float(c.frequencies()[0]) / (2 * np.pi)) * MILLI for c in chains])
        self.readings = grid.frames.readings * MILLI
        self._objects: dict[str, tuple[float, Surface]] = {}
        self._turns: dict[float, NDArray[np.float64]] = {}
        self._bases = [_base_knot(mount, grid) for mount in mounts]
        spans = np.diff(self.readings, prepend=0.0)
        self.steps_each = np.array([int(np.ceil(spans / step - 1e-3).clip(1).sum()) for step in self.steps])

    def launch(
        self, objects: Sequence[tuple[str, Sequence[Any]]], only: NDArray[np.bool_] | None = None, finer: int = 1
    ) -> SweepResult:
        """Simulate sweeps, object by object.

        Args:
            objects: (name, its sweeps) in the order of the result's first axis.
            only: [sweep, whisker] which whiskers; all when None. Nothing is computed for the others.
            finer: divides the time steps.
        """
        wp, kernels, device = warp(), self.kernels, self.device
        clock = [time.perf_counter()]
        tracks = Tracks()
        bases = [tracks.add(knot, 0.0, 1.0) for knot in self._bases]
        shapes = Shapes()
        prepared = self._prepare([name for name, _ in objects])
        for name, sweeps in objects:
            if len(sweeps):
                self._add(shapes, tracks, *prepared[name], sweeps)
        clock.append(time.perf_counter())
        count, whiskers = len(shapes.first) - 1, len(self._bases)
        # Neighbouring threads take the same whisker past the same object.
        whisker, row = (
            grid.ravel().astype(np.int32) for grid in np.meshgrid(np.arange(whiskers), np.arange(count), indexing="ij")
        )
        if only is not None:
            whisker, row = (some[only[row, whisker]] for some in (whisker, row))
        lanes = {
            "whisker": whisker,
            "scene": row,
            "base": np.array(bases, dtype=np.int32)[whisker],
            "step": self.steps[whisker] / finer,
            "row": row,
            "column": whisker,
            "load_first": np.zeros(len(row) + 1, dtype=np.int32),
            "load_link": np.zeros(0, dtype=np.int32),
            "load_share": np.zeros(0),
            "load_force": np.zeros((0, 3)),
            "load_stop": np.zeros(0),
        }
        out = kernels.structs.ResultArrays()
        frames, real = len(self.readings), self.real
        out.wrench = wp.zeros((count, frames, whiskers, 6), dtype=real, device=device)
        out.contact = wp.full((count, frames, whiskers), -1.0, dtype=real, device=device)
        out.points, out.contact_wrench = (
            wp.zeros((1, 1, 1), dtype=kernels.structs.vec3, device=device) for _ in range(2)
        )
        out.depth, out.failed, out.miss, out.load = (wp.zeros(len(row), dtype=real, device=device) for _ in range(4))
        names = ("status", "steps", "touching", "crowded", "unsolved")
        for name in names:
            setattr(out, name, wp.zeros(len(row), dtype=wp.int32, device=device))
        options = kernels.structs.StepOptions()
        options.axes = kernels.structs.mat33(*self._head.ravel().tolist())
        options.quasistatic = int(self.quasistatic)
        inputs = [
            self._chains,
            to_struct(kernels.structs.MotionArrays, tracks.arrays(), device),
            to_struct(kernels.structs.ShapeArrays, shapes.arrays(), device),
            to_struct(kernels.structs.JobArrays, lanes, device),
            options,
            wp.array(self.readings, dtype=real, device=device),
            out,
            make_problems(kernels, self.capacity, len(row), device),
        ]
        wp.synchronize_device(device)
        clock.append(time.perf_counter())
        if self.sliced:
            slices = Slices(kernels, real, self.capacity, len(row), device, **self.tuning)
            self.slices = slices.run(inputs, BLOCK)
        else:
            wp.launch(
                kernels.run, len(row), [*inputs, kernels.structs.PausedWhiskers()], device=device, block_dim=BLOCK
            )
        wp.synchronize_device(device)
        clock.append(time.perf_counter())
        self.seconds = dict(zip(("objects", "upload", "kernel"), np.diff(clock).tolist(), strict=True))

        def table(values: Any) -> NDArray:
            whole = np.zeros((count, whiskers), dtype=values.dtype)
            whole[row, whisker] = values
            return whole

        found = {name: table(getattr(out, name).numpy()) for name in names}
        return SweepResult(
            wrench=out.wrench,
            contact=out.contact,
            status=found["status"],
            steps=found["steps"],
            touching=found["touching"],
            unsolved=found["unsolved"],
            crowded=found["crowded"],
            depth=table(out.depth.numpy()),
            doubt=table(np.sqrt(out.miss.numpy() / np.maximum(out.load.numpy(), 1e-30))),
            steps_in_full=int(self.steps_each.sum()) * count,
        )

    @property
    def limit(self) -> int:
        """Most sweeps of one object that are launched together on this device."""
        return 4096 if self.device.is_cuda else 4

    def batch(self, result: SweepResult) -> SweepBatch:
        """Return a result as frames in the form of data generation."""
        from brainbench.stimuli.sweeps.simulation import SweepBatch

        frames = self.grid.frames
        wrench, contact = result.wrench.numpy(), np.greater_equal(result.contact.numpy(), 0)
        if frames.average > 1 or frames.lowpass is not None:
            moved = np.moveaxis(wrench, 1, 0)
            wrench = np.moveaxis(frames.reduce(moved.astype(float)), 0, 1).astype(np.float32)
            contact = np.asarray(frames.split(np.moveaxis(contact, 1, 0)).any(axis=1)).swapaxes(0, 1)
        unstable = result.unstable
        names = [mount.name for mount in self.scenes.array]
        reasons = [""] * len(unstable)
        for row in np.flatnonzero(unstable.any(axis=1)).tolist():
            first = int(np.argmax(unstable[row]))
            more = f" (and {unstable[row].sum() - 1} more whiskers)" if unstable[row].sum() > 1 else ""
            reasons[row] = f"{names[first]}: {result.reason(row, first)}{more}"
        wrench[np.broadcast_to(unstable[:, None, :, None], wrench.shape)] = np.nan
        return SweepBatch(
            wrench=wrench.astype(np.float32, copy=False),
            contact=contact.mean(axis=1).astype(np.float32),
            unstable=unstable,
            reasons=tuple(reasons),
            steps=int(result.steps.sum()),
            steps_in_full=result.steps_in_full,
        )

    def trusted(self, objects: Sequence[tuple[str, Sequence[Any]]], retry: int) -> SweepBatch:
        """Simulate sweeps, and whiskers that cannot be trusted again with finer steps.

        Their steps are divided by ``retry``, and those of the few that cannot be trusted even then by twice that.

        Args:
            objects: as for :meth:`launch`.
            retry: 1 leaves such whiskers as they are.
        """
        batch = self.batch(self.launch(objects))
        flat = [(name, sweep) for name, sweeps in objects for sweep in sweeps]
        retried = 0
        for finer in finer_steps(retry):
            rows = np.flatnonzero(batch.unstable.any(axis=1))
            if len(rows):
                retried = max(retried, len(rows))
                batch = self._again(batch, rows, [flat[row] for row in rows], finer)
        return replace(batch, retried=retried)

    def _again(
        self, batch: SweepBatch, rows: NDArray[np.intp], sweeps: list[tuple[str, Any]], finer: int
    ) -> SweepBatch:
        """Return the batch with the whiskers that could not be trusted, of these rows, simulated with finer steps."""
        groups = [(name, [sweep for _, sweep in some]) for name, some in groupby(sweeps, key=itemgetter(0))]
        only = batch.unstable[rows]
        again = self.batch(self.launch(groups, only, finer))
        wrench, contact, unstable = batch.wrench, batch.contact, batch.unstable
        wrench[rows] = np.where(only[:, None, :, None], again.wrench, wrench[rows])
        contact[rows] = np.where(only, again.contact, contact[rows])
        unstable[rows] = again.unstable
        reasons = list(batch.reasons)
        for row, reason in zip(rows.tolist(), again.reasons, strict=True):
            reasons[row] = reason
        return replace(
            batch,
            wrench=wrench,
            contact=contact,
            unstable=unstable,
            reasons=tuple(reasons),
            steps=batch.steps + again.steps,
        )

    def _prepare(self, names: Sequence[str]) -> dict[str, tuple[float, Surface]]:
        """Return the diagonal (m) and the surface (mm) of objects.

        Those of the last launch are kept: whiskers are simulated again, and large objects come in several launches.
        """
        # Launches may run side by side.
        known, new = self._objects, []
        for name in dict.fromkeys(names):
            if name not in known:
                solid = self.scenes.solid(name)
                if solid.surface is None:
                    raise UsageError(
                        f"The object {solid.name!r} has no exact surface to sweep over; use the backend 'mujoco'."
                    )
                new.append((name, solid.diagonal, solid.surface))

        def order(surface: TriangleMesh) -> Surface:
            return Surface.of(surface.vertices * MILLI, surface.faces)

        # Sorting leaves Python's lock alone. On a processor several launches are made side by side as it is.
        with ThreadPoolExecutor(min(8, os.cpu_count() or 1) if self.device.is_cuda else 1) as pool:
            ordered = pool.map(order, [surface for *_, surface in new])
            made = {name: (diagonal, some) for (name, diagonal, _), some in zip(new, ordered, strict=True)}
        self._objects = {name: made[name] if name in made else known[name] for name in names}
        return {**known, **made}

    def _add(self, shapes: Shapes, tracks: Tracks, diagonal: float, surface: Surface, sweeps: Sequence[Any]) -> None:
        """Append the scenes of one object's sweeps, expressed in the frame of the array.

        Numbers are the same whatever sweeps come together: sums of products are written out, term by term.
        """
        grid, head = self.grid, self._head
        rotations = sorted({sweep.rotation for sweep in sweeps})
        turns = np.array([self._turn(rotation) for rotation in rotations])
        # Turned about z: how far it then reaches along x and y.
        x, y = surface.outline.T
        low = np.stack([(turns[:, k, 0, None] * x + turns[:, k, 1, None] * y).min(axis=1) for k in (0, 1)], axis=1)
        quaternion = quaternions(head.T @ turns)
        which = np.searchsorted(rotations, [sweep.rotation for sweep in sweeps])
        speed, height, distance, size = (
            np.array([getattr(sweep, name) for sweep in sweeps]) for name in ("speed", "height", "distance", "size")
        )
        scale = size / diagonal
        reach = low[which] * (scale / MILLI)[:, None]
        side = grid.start - reach[:, 1] if grid.placing == "clear" else grid.start + reach[:, 1]
        place = np.stack([distance - reach[:, 0], side, height], axis=1) - self._origin
        knots = np.zeros((len(sweeps), 16))
        for k in range(3):
            knots[:, k] = (place[:, 0] * head[0, k] + place[:, 1] * head[1, k] + place[:, 2] * head[2, k]) * MILLI
            knots[:, 3 + k] = -speed * head[1, k]
        knots[:, 6:10] = quaternion[which]
        still = np.tile([1.0, 0.0, 0.0, 0.0], (len(sweeps), 1))
        radius = surface.radius * scale
        shapes.add_placed(
            surface, track=tracks.add_straight(knots), turn=still, scale=scale, radius=radius, speed=speed
        )

    def _turn(self, rotation: float) -> NDArray[np.float64]:
        """Return the matrix of a rotation about z; grids have few."""
        if rotation not in self._turns:
            self._turns[rotation] = euler_matrix((0.0, 0.0, rotation))
        return self._turns[rotation]


BLOCK = 64
"""Threads of one block on a GPU."""
BOUNDS = (BLOCK, 8)
"""CUDA launch bounds: registers are spilled for twice as many threads at a time (benchmarks/RESULTS.md)."""
SLICED_BOUNDS = (BLOCK, 4)
"""The same for whiskers in slices, whose registers are needed more than further threads."""


def _base_knot(mount: Any, grid: SweepGrid) -> NDArray[np.float64]:
    from brainbench.stimuli.engines.protocol import base_rotation

    angles = np.array([mount.angles])
    return still_knots(np.asarray(mount.position), quaternions(base_rotation(angles))[0])


def simulate_sweeps(
    scenes: SweepScenes,
    indices: Sequence[int],
    *,
    fidelity: Fidelity,
    device: str = "cpu",
    workers: int | None = None,
    retry: int = 1,
) -> SweepBatch:
    """Simulate sweeps as :func:`brainbench.stimuli.sweeps.simulation.simulate_sweeps` asks; see there.

    On the CPU one thread takes one object at a time; ``workers`` of them run side by side.
    """
    from brainbench.stimuli.sweeps.simulation import join_batches

    launcher = SweepLauncher(scenes, fidelity, device)
    groups = list(_by_object(scenes, indices, launcher.limit))

    def run(group: tuple[str, list[Any]]) -> SweepBatch:
        return launcher.trusted([group], retry)

    if launcher.device.is_cuda:
        return launcher.trusted(groups, retry)
    with ThreadPoolExecutor(max_workers=workers or 1) as pool:
        return join_batches(list(pool.map(run, groups)))


def _by_object(scenes: SweepScenes, indices: Sequence[int], limit: int) -> Iterator[tuple[str, list[Any]]]:
    """(object name, sweeps) of neighbouring indices, at most ``limit`` sweeps together."""
    last, sweeps = "", []
    for index in indices:
        which, within = divmod(index, scenes.grid.count)
        name = scenes.objects[which]
        if sweeps and (name != last or len(sweeps) >= limit):
            yield last, sweeps
            sweeps = []
        last = name
        sweeps.append(scenes.grid.sweeps(name)[within])
    if sweeps:
        yield last, sweeps
