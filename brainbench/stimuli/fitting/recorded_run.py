"""Runs of the engine ``rod`` that are written down, and the derivatives of their results by whatever was packed.

**One step**, as the kernels solve it. State: joint angles q and rates q̇, 2 or 3 hinges a joint; step length h. With the
spatial inertia I of each link, its twist V and acceleration A (of the base as its track moves within the step, less
gravity), the joint springs k, lag = max(β, h), and the contact forces f at points p of the skin, it finds a and f with

    H(q) a + C(q, q̇) + k (q + lag (q̇ + h a)) = Σ loads + Σ Jᵀf                              (the chain)

which is (M + h D + h² K) q̇⁺ = M q̇ + h (…) with the damping D = (lag − h) K: linearly implicit springs. Behind a bend of
``limits.FOLD`` a joint is stiffer. Then q̇⁺ = q̇ + h a and q⁺ = q + h q̇⁺; a quasi-static step forgets q̇⁺. A contact has a
gap g, a normal n and the closing rate κ = min(−g, ``limits.CREVICE``)/h, of the bent rod at most ``limits.UNDONE``;
with the velocity v of the skin against the object at the end of the step (the object's is that in the middle of the
step, at the contact's present place), the Coulomb problem has one of three solutions at each:

    open       f = 0
    sticking   v = κ n,                                                            |f − n (n·f)| ≤ μ n·f
    sliding    n·v = κ,  f − n (n·f) = −μ (n·f) u,  u the direction of v − n (n·v)

A reading is the wrench at the base of the step that begins at its time, and the joints' places at its beginning.

**Derivatives.** The step solves R(a, f; q, q̇, θ) = 0. By the implicit function theorem the changes of a and f with a
change of q, q̇ and the packed numbers θ solve the linear system ∂R/∂(a, f) (δa, δf) = −δR, where δR is the change at
fixed a and f. How the forces were iterated plays no part; contacts keep the state that the solution has. The chain's
part of the system is symmetric: the factorised chain solves it in O(links). The contacts' part is a dense system of
3 × contacts. Contact points move over spheres, cylinders, faces, edges and corners by the second derivatives of the
distance (``kernels.recording``), and with the bent rod (``kernels.centre_line``), whose state also holds mean forces of
contacts and its shortening. So one pass over the steps gives the changes of all readings, at one solution a step for
each parameter (``kernels.tangent``). Forces of recorded steps are solved to rounding, which those of the ordinary
engine are not: the theorem holds at the solution.

**Memory.** Runs whose steps take at most ``ROOM`` are written down as they go. Longer ones pause after every √steps
steps, where the state is kept; each segment is then run again from there and written down, the same steps to the digit.
Step lengths are those that the run took: derivatives are at a fixed sequence of steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import warp
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.launch import WhiskerSolver
from brainbench.stimuli.engines.rod.limits import contacts_for
from brainbench.stimuli.engines.rod.packing import PackedJobs
from brainbench.stimuli.engines.rod.slices import SceneParts, allocate, lock_of
from brainbench.stimuli.motion.jobs import MICRO, MILLI
from brainbench.stimuli.whiskers.whisker import Chain

LINK_ROWS = 28
"""Numbers of a link, see ``kernels.chain.PackedTangents``."""
KERNELS = f"{__package__}.kernels"  # package that writes steps down
ROOM = 2**26  # bytes that records of the steps of a launch may take; beyond them they are written down in parts


class RecordingSolver(WhiskerSolver):
    """A solver whose launches can be gone over again. In double precision."""

    room = ROOM
    """Bytes that records of steps may take."""

    def __init__(self, chains: Sequence[Chain], fidelity: Fidelity, device: Any, needs: int, *, twists: bool) -> None:
        """Load kernels; arguments as for :class:`.launch.WhiskerSolver`."""
        super().__init__(chains, fidelity, device, needs, twists=twists, recorder=KERNELS)
        self.scene: Any = None
        """What the last launch was given, on the device; its contact problems and results beside it."""
        self.problems: Any = None
        self.results: Any = None
        self.checkpoints: list[tuple[Any, Any, Any]] = []
        """States of whiskers, their links and their contacts at the beginning of each segment."""

    def _take_steps(self, scene: SceneParts, problems: Any, results: Any, jobs: PackedJobs) -> None:
        wp, device, structs, count = warp(), self.device, self.kernels.structs, len(jobs)
        time = scene.readings.time.numpy()
        spans = np.diff(time["tick"] + time["part"], prepend=0.0)
        steps = int(np.ceil(spans / scene.jobs.step.numpy().min()).sum()) + 8
        with lock_of(device):
            links = (self.capacity, count)
            self.paused = allocate(structs.PausedWhiskers, device, state=count, ended=count, link=links)
            single = self._records(1, count)
            affordable = self.room // sum(getattr(single, name).capacity for name in structs.StepRecords.vars)
            self.paused.budget = budget = max(8, math.ceil(math.sqrt(steps)), min(steps, affordable))
            self.paused.records = self._records(budget, count)
            self.paused.keep = int(budget >= steps)
            self.scene, self.problems, self.results, self.checkpoints = scene, problems, results, []
            while not self.checkpoints or not self.paused.ended.numpy().all():
                held = problems.held
                self.checkpoints.append((wp.clone(self.paused.state), wp.clone(self.paused.link), wp.clone(held)))
                self._run()
            wp.synchronize_device(device)

    def _records(self, steps: int, count: int) -> Any:
        """Return room for so many steps of each of ``count`` jobs."""
        links, contacts = (steps, self.capacity, count), (steps, contacts_for(self.capacity), count)
        shapes = {"step": (steps, count), "count": count, "contact": contacts}
        shapes |= dict.fromkeys(("angle", "rate", "acceleration"), links)
        if self.smooth:
            shapes["steady"] = contacts
        return allocate(self.kernels.structs.StepRecords, self.device, **shapes)

    def _run(self) -> None:
        self.paused.records.count.zero_()
        arguments = [*self.scene, self.problems, self.paused, self.results]
        warp().launch(self.kernels.run, self.count, arguments, device=self.device)

    def _segments(self) -> Iterator[Any]:
        """Yield the records of the segments that begin at checkpoints; each is run again unless there is one."""
        wp = warp()
        whole = self.paused.keep == 1 and len(self.checkpoints) == 1
        self.paused.keep = 1
        for checkpoint in self.checkpoints:
            if not whole:
                current = self.paused.state, self.paused.link, self.problems.held
                for before, now in zip(checkpoint, current, strict=True):
                    wp.copy(now, before)
                self._run()
            yield self.paused.records

    @property
    def count(self) -> int:
        """Jobs of the last launch."""
        return self.paused.state.shape[0]

    @property
    def packed_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the packed arrays that changes are of, see ``kernels.tangent.PackedTangents``."""
        scene = self.scene
        loads, solids = int(scene.jobs.load_force.shape[0]), int(scene.shapes.kind.shape[0])
        return {
            "link": (LINK_ROWS, self.capacity, self.count),
            **dict.fromkeys(("beta", "friction"), (self.count,)),
            "gravity": (self.count, 3),
            "knots": (int(scene.motions.place.shape[0]), 16),
            "load_force": (loads, 3),
            "load_share": (loads,),
            **{f"shape_{name}": (solids, 3) for name in ("place", "turn", "size")},
            "shape_friction": (solids,),
        }

    def forward(self, changes: Mapping[str, NDArray[np.float64]]) -> dict[str, NDArray[Any]]:
        """Go over the last launch again; return the change of its results with that of what was packed.

        Args:
            changes: [p, …] by parameter, of the arrays and shapes of :attr:`packed_shapes`.

        Returns:
            ``wrench`` [p, job, reading, 6], ``points`` [p, job, reading, node, 3] from the base point,
            ``contact_wrench`` [p, job, reading, 6] in SI units, and ``contacts`` [job], the summary of the run's
            contacts (``kernels.contacts.ContactSummary``).
        """
        from brainbench.stimuli.engines.rod.kernels import BUILDING, specialize

        wp, device = warp(), self.device
        with BUILDING:
            kernels = specialize("recorder.tangent", **self.kernels.parameters)
        count, some = self.count, len(changes["beta"])
        frames = int(self.scene.readings.row.numpy().max()) + 1
        with lock_of(device):
            state = (some, self.capacity, count)
            held = (some, contacts_for(self.capacity), count)
            shapes: dict[str, Any] = dict.fromkeys(("angle", "rate"), state)
            if self.smooth:
                shapes |= {**dict.fromkeys(("mean", "steady", "arc"), held), "shorter": state, "last": count}
            tangents = allocate(kernels.PackedTangents, device, **shapes)
            for name, values in changes.items():
                setattr(
                    tangents, name, wp.array(values, dtype=kernels.PackedTangents.vars[name].type.dtype, device=device)
                )
            system = allocate(
                kernels.ContactSystem, device, unit=(3 * contacts_for(self.capacity), self.capacity, count)
            )
            outputs = allocate(
                kernels.OutputTangents,
                device,
                points=(some, frames, self.capacity + 1, count),
                **dict.fromkeys(("wrench", "contact"), (some, frames, 2, count)),
                contacts=count,
            )
            scene = self.kernels.structs.SceneArrays()
            for name, part in self.scene._asdict().items():
                setattr(scene, name, part)
            for records in self._segments():
                arguments = [scene, records, system, tangents, outputs]
                wp.launch(kernels.tangent_segment, count, arguments, device=device)
            wrench, points, contact = (
                np.moveaxis(values.numpy(), 3, 1) for values in (outputs.wrench, outputs.points, outputs.contact)
            )
            summaries = outputs.contacts.numpy()
        units = np.array([MILLI, MICRO])[:, None]
        # The kernels find the wrench of the base on the whisker, moment first.
        return {
            "wrench": (-wrench[:, :, :, ::-1] / units).reshape(*wrench.shape[:3], 6),
            "points": points / MILLI,
            "contact_wrench": (contact / units).reshape(*contact.shape[:3], 6),
            "contacts": summaries,
        }
