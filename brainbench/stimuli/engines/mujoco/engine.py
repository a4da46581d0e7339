"""MuJoCo as a whisker engine: the independent CPU reference.

Uses the ``discrete`` integrator of MuJoCo ≥ 4, which solves springs, dampers and contacts together in
the metric M + hD + h²K, so the time step is limited by accuracy and not by stability. Each whisker is its
own small model; native threads run the jobs.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from brainbench.core.rotations import euler_matrix
from brainbench.stimuli.engines.mujoco.model import ARMATURE, SLOT_WIDTH, WhiskerModel, build_model, engine
from brainbench.stimuli.engines.reach import LARGEST_SLIDE, Reach, stays_in_plane
from brainbench.stimuli.engines.stepping import SteppedEngine, SteppedJob
from brainbench.stimuli.engines.trust import (
    GAVE_WAY,
    LARGEST_BEND,
    LARGEST_CHANGE,
    fault,
    state_fault,
    strongest_force,
)
from brainbench.stimuli.engines.units import MICRO, MILLI
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.whiskers.chain import Chain

logger = logging.getLogger(__name__)

CHUNK = 250
"""Steps per native call: bounds the memory of a job, and the drift of prescribed joints between resets."""


@dataclass(frozen=True)
class MujocoWhiskerEngine(SteppedEngine):
    """Runs whisker jobs in MuJoCo."""

    name = "mujoco"
    twists = True
    yields = True
    package = "mujoco-core"
    revision = "+1"  # one contact for a pair of convex bodies

    @contextlib.contextmanager
    def session(self) -> Iterator[None]:
        """Send MuJoCo's warnings to our log; by itself it prints them and writes MUJOCO_LOG.TXT."""
        mujoco = engine()
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda message: logger.debug("MuJoCo: %s", message))
        try:
            yield
        finally:
            mujoco.set_mju_user_warning(before)

    def simulate(self, stepped: SteppedJob) -> Trace:
        """See :meth:`SteppedEngine.simulate`."""
        job, chain = stepped.job, stepped.chain
        free = stepped.fidelity.twist is not False
        twists = free and not stays_in_plane(job, stepped.reach, *stepped.pose, stepped.times)
        tolerance = stepped.fidelity.contact_tolerance
        built = build_model(
            job, chain, stepped.reach, stepped.step, stepped.times, twists=twists, contact_tolerance=tolerance
        )
        sensors, hinges, failed, reason = _integrate(built, job, stepped.times)
        displacement, still = None, built
        if len(built.yielding):
            displacement, hinges, built = _give_way(built, sensors, hinges)
            far = np.abs(displacement) >= np.repeat([LARGEST_SLIDE * job.whisker.arc_length, LARGEST_BEND], 3)
            first = int(np.argmax(far.any(axis=1)))
            if far[first].any() and first < failed:
                failed, reason = first, fault(GAVE_WAY, float(stepped.times[first]), 0.0)
        failed, reason = stepped.end(failed, reason)
        frames = stepped.frames(failed)
        nearest = frames.nearest
        shape = _shape(built, chain, hinges[nearest], nearest)
        contact, arc = _contacts(sensors[nearest, 6:], shape, chain)
        if stepped.record_shape:
            # As the wrench: between steps a whisking follicle turns by more than its whisker bends.
            shape = frames.interpolate(lambda steps: _shape(built, chain, hinges[steps], steps))
        return stepped.trace(
            frames,
            frames.interpolate(lambda steps: _wrench(still, sensors, steps)),
            contact,
            arc,
            shape / MILLI,
            penetration=_penetration(sensors[: failed + 1, 6:], hinges[: failed + 1], built, chain),
            reason=reason,
            steps=failed,
            displacement=None if displacement is None else frames.interpolate(displacement.__getitem__),
            doubt=_lost_friction(*_friction(sensors[:failed, 6:], job, stepped.reach)),
        )


def _give_way(
    built: WhiskerModel, sensors: NDArray, joints: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64], WhiskerModel]:
    """Return how far the follicle is before every step [n, 6] (m, rad), the whisker's own hinges [n, hinge], and the
    model with its base there; moments of ``sensors`` [n, …] are put about the new base."""
    from scipy.spatial.transform import Rotation

    count = len(built.yielding)
    places = np.zeros((len(joints), 6))
    places[:, built.yielding] = joints[:, :count]
    slide, turns = places[:, :3], Rotation.from_euler("XYZ", places[:, 3:])
    # Sensors stand where the follicle would be if it were rigid.
    sensors[:, 3:6] -= np.cross(slide, sensors[:, :3])
    arm = np.einsum("nij,nj->ni", built.rotation, slide)
    moved = replace(built, base=built.base + arm, rotation=built.rotation @ turns.as_matrix())
    return np.concatenate([slide / MILLI, turns.as_rotvec()], axis=1), joints[:, count:], moved


def _wrench(built: WhiskerModel, sensors: NDArray, steps: NDArray) -> NDArray[np.float64]:
    """Return force and moment [n, 6] (N, N·m, world) of the whisker on its base before ``steps`` [n]."""
    # From mN and µN·m to SI units, then from the frame of the base to the world.
    local = sensors[steps, :6] * np.repeat([1 / MILLI, 1 / MICRO], 3)
    # MuJoCo's sensor reads the action of the base on the whisker, in the frame of the base.
    return -np.einsum("nij,nkj->nki", built.rotation[steps], local.reshape(-1, 2, 3)).reshape(-1, 6)


def _integrate(
    built: WhiskerModel, job: Job, times: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64], int, str]:
    """Step the model; return sensors [n, …] and hinge angles [n, hinge] before every step, first bad step, reason.

    The first bad step is n, and the reason empty, when all went well.
    """
    mujoco, rollout = engine(), import_module("mujoco.rollout")
    model = built.model
    data = mujoco.MjData(model)
    steps, strongest = len(times) - 1, strongest_force(job.whisker) * MILLI
    sensors = np.zeros((steps, model.nsensordata))
    axes = len(built.yielding)
    hinges = np.zeros((steps, axes + 2 * len(built.twisting) + np.count_nonzero(built.twisting)))
    spec = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
    if job.loads:
        spec |= int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
    state = np.zeros(mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    at = slice(1, 1 + model.nq)
    rate = slice(1 + model.nq, 1 + model.nq + model.nv)
    state[at] = model.qpos0
    for first in range(0, steps, CHUNK):
        count = min(CHUNK, steps - first)
        control = _control(built, job, times[first : first + count], first)
        q = v = 0
        # Prescribed coordinates are put on their path at the start of every chunk, so that rounding does not add up.
        for drive in built.drives:
            position, velocity = drive.position[first], drive.velocity[first]
            state[at][q : q + len(position)] = position
            state[rate][v : v + len(velocity)] = velocity
            q, v = q + len(position), v + len(velocity)
        state[0] = times[first] * MILLI
        states, read = rollout.rollout(
            model,
            data,
            state[None],
            control[None],
            control_spec=spec,
            initial_warmstart=data.qacc_warmstart[None].copy(),
        )
        window = slice(first, first + count)
        sensors[window] = read[0]
        angles = states[0, :, at][:, q:]
        hinges[first] = state[at][q:]
        hinges[first + 1 : first + count] = angles[:-1]
        warned = [str(mujoco.mjtWarning(int(kind)).name) for kind in np.flatnonzero(data.warning.number)]
        # Also true of NaN; looking at every step by itself takes as long as a step of a short chain.
        sound = np.isfinite(read).all() and np.abs(hinges[window, axes:]).max() < LARGEST_BEND
        if warned or not sound or np.abs(read[0, :, :3]).max() > strongest:
            bad = ~np.isfinite(read[0]).all(axis=1) | ~(np.abs(hinges[window, axes:]) < LARGEST_BEND).all(axis=1)
            bad |= np.abs(read[0, :, :3]).max(axis=1) > strongest
            failed = first + (int(np.argmax(bad)) if bad.any() else 0)
            fault = state_fault(hinges[failed, axes:], sensors[failed, :6] / MILLI, job.whisker)
            fault = fault or f"MuJoCo warned of {', '.join(warned) or 'a non-finite sensor'}"
            return sensors, hinges, failed, f"at {times[failed]:.6g} s {fault}"
        state = states[0, -1].copy()
    return sensors, hinges, steps, ""


def _control(built: WhiskerModel, job: Job, times: NDArray, first: int) -> NDArray[np.float64]:
    """Return the inputs of every step [count, …]: generalised forces on the prescribed joints, then the loads."""
    forces = np.zeros((len(times), built.model.nv))
    column = 0
    for drive in built.drives:
        width = drive.acceleration.shape[1]
        # F = B a: against an armature of 1e9 the reaction of the whisker changes nothing that counts.
        forces[:, column : column + width] = ARMATURE * drive.acceleration[first : first + len(times)]
        column += width
    if not job.loads:
        return forces
    external = np.zeros((len(times), built.model.nbody, 6))
    for body, load in zip(built.loads, job.loads, strict=True):
        external[times < load.stop, body, :3] = np.multiply(load.force, MILLI)
    return np.concatenate([forces, external.reshape(len(times), -1)], axis=1)


def _shape(built: WhiskerModel, chain: Chain, hinges: NDArray, steps: NDArray) -> NDArray[np.float64]:
    """Return joint and tip positions [n, N + 1, 3] (mm, world) from hinge angles [n, hinge] before ``steps`` [n]."""
    frame = built.rotation[steps]
    points = [built.base[steps]]
    first = 0
    for i, twists in enumerate(built.twisting):
        # Rest bend about z, then the hinges about y and z, as in the model; twist comes before half of the rest bend.
        half = chain.rest_angles[i] / 2 if twists else 0.0
        frame = frame @ _rotation_zyz(chain.rest_angles[i] - half, hinges[:, first], hinges[:, first + 1])
        if twists:
            # Rotations about x turn y and z; two columns are combined in place of a matrix product.
            c, s = np.cos(hinges[:, first + 2])[:, None], np.sin(hinges[:, first + 2])[:, None]
            x, y, z = np.moveaxis(frame, -1, 0)
            frame = np.stack([x, c * y + s * z, c * z - s * y], axis=-1) @ euler_matrix((0.0, 0.0, half))
        first += 2 + int(twists)
        points.append(points[-1] + frame[:, :, 0] * chain.lengths[i] * MILLI)
    return np.stack(points, axis=1)


def _rotation_zyz(rest: float, y: NDArray, z: NDArray) -> NDArray[np.float64]:
    """Return rotations [n, 3, 3] Rz(rest) · Ry(y) · Rz(z)."""
    cr, sr = np.cos(rest), np.sin(rest)
    cy, sy, cz, sz = np.cos(y), np.sin(y), np.cos(z), np.sin(z)
    zero = np.zeros_like(y)
    # Ry · Rz written out for all steps at once, in place of a stack of matrix products.
    turn = np.stack([cy * cz, -cy * sz, sy, sz, cz, zero, -sy * cz, sy * sz, cy], axis=-1).reshape(-1, 3, 3)
    return np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]]) @ turn


def _contacts(slots: NDArray, shape: NDArray, chain: Chain) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return whether there is contact [n], and the force-weighted mean arc length (m) of the contact points [n]."""
    slots = slots.reshape(len(slots), -1, SLOT_WIDTH)
    # Weighted by force, so that a contact that merely grazes does not pull the mean arc towards itself.
    force = np.linalg.norm(slots[..., 1:4], axis=-1)
    total = force.sum(axis=1)
    contact = total > 0
    arc = np.full(len(slots), np.nan)
    arcs = _nearest_arcs(slots[contact, :, 5:8], shape[contact], chain)
    arc[contact] = np.sum(force[contact] * arcs, axis=1) / total[contact]
    return contact, arc


def _nearest_arcs(points: NDArray, joints: NDArray, chain: Chain) -> NDArray[np.float64]:
    """Return the arc lengths [n, k] (m) of the points of chains [n, N + 1, 3] nearest to ``points`` [n, k, 3]."""
    along = np.diff(joints, axis=1)[:, None]
    offset = points[:, :, None] - joints[:, None, :-1]
    # Nearest point of every link as a segment, all links at once; the nearest of them gives the arc length.
    share = np.clip(np.sum(offset * along, axis=-1) / np.sum(along**2, axis=-1), 0, 1)
    distance = np.linalg.norm(offset - share[..., None] * along, axis=-1)
    link = np.argmin(distance, axis=-1)
    share = np.take_along_axis(share, link[..., None], axis=-1)[..., 0]
    return chain.nodes[link] + share * np.diff(chain.nodes)[link]


def _friction(slots: NDArray, job: Job, reach: Reach) -> tuple[float, float]:
    """Return the friction of the objects, and what contacts hold of it (root mean square); 0 and 0 without contact."""
    friction = min((item.friction_beside(job.whisker.friction) for item in reach.obstacles), default=0.0)
    squares = np.sum(slots.reshape(-1, SLOT_WIDTH)[:, 1:4] ** 2, axis=0)
    return (friction, float(np.sqrt(squares[1:].sum() / squares[0]))) if squares[0] > 0 else (0.0, 0.0)


def _lost_friction(friction: float, held: float) -> str:
    """Return in words that soft contacts hold too little friction; empty if enough.

    A whisker against an object creeps along it, so that Coulomb's law asks for almost all of the friction. Soft
    friction is viscous below some cm/s and lets go.
    """
    # What is missing, as a share of the whole force of a contact that slips.
    if friction - held <= LARGEST_CHANGE * np.hypot(1, friction):
        return ""
    return (
        f"soft contacts hold {held / friction:.0%} of the friction {friction:g} (root mean square); use the backend "
        "'rod', or friction 0"
    )


def _penetration(slots: NDArray, hinges: NDArray, built: WhiskerModel, chain: Chain) -> float:
    """Return the deepest overlap (m) of whisker and obstacle over all steps.

    MuJoCo reports the distance from the core of a link, so the link's margin is added back.
    """
    if not slots.size:
        return 0.0
    slots = slots.reshape(len(slots), -1, SLOT_WIDTH)
    # At most: as if every contact were on the link of the largest margin.
    most = np.where(slots[..., 0] > 0, built.margins.max() - slots[..., 4], -np.inf).max(axis=1)
    touching = np.argsort(-most, kind="stable")[: np.count_nonzero(most > -np.inf)]
    deepest = 0.0
    for steps in np.array_split(touching, len(touching) // CHUNK + 1):
        if not len(steps) or most[steps[0]] <= deepest:
            break
        gaps = slots[steps]
        arcs = _nearest_arcs(gaps[..., 5:8], _shape(built, chain, hinges[steps], steps), chain)
        link = np.clip(np.searchsorted(chain.nodes, arcs, side="right") - 1, 0, chain.links - 1)
        overlap = np.where(gaps[..., 0] > 0, built.margins[link] - gaps[..., 4], 0.0)
        deepest = max(deepest, float(overlap.max(initial=0.0)))
    return deepest / MILLI
