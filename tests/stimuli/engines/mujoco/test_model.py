"""MuJoCo's model of a whisker: its follicle is driven along the trajectory."""

from dataclasses import replace
from importlib import import_module

import numpy as np

from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.reach import reachable
from brainbench.stimuli.motion.jobs import Job
from brainbench.stimuli.whiskers.chain import build_chain
from tests.factories.obstacles import post
from tests.factories.swing import Oscillation
from tests.factories.whiskers import C2

COARSE = Fidelity(links=8, time_step=1e-4)


def _run(*jobs, fidelity=COARSE, **options):
    return get_engine("mujoco").run(jobs, fidelity, **options)


def _follow(built, steps):
    """Prescribed coordinates [steps, …] as MuJoCo integrates them from chunk to chunk."""
    mujoco, rollout = import_module("mujoco"), import_module("mujoco.rollout")
    from brainbench.stimuli.engines.mujoco.engine import CHUNK
    from brainbench.stimuli.engines.mujoco.model import ARMATURE

    model, drive = built.model, built.drives[-1]
    width = drive.position.shape[1]
    out, state = [], None
    for first in range(0, steps, CHUNK):
        count = min(CHUNK, steps - first)
        if state is None:
            state = np.zeros(1 + model.nq + model.nv)
        state[1 : 1 + width] = drive.position[first]
        state[1 + model.nq : 1 + model.nq + width] = drive.velocity[first]
        force = np.zeros((1, count, model.nv))
        force[0, :, :width] = ARMATURE * drive.acceleration[first : first + count]
        states, _ = rollout.rollout(
            model, mujoco.MjData(model), state[None], force, control_spec=int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        )
        out += [state[None, 1 : 1 + width].copy(), states[0, :-1, 1 : 1 + width]]
        state = states[0, -1].copy()
    return np.concatenate(out)


def test_the_follicle_follows_its_trajectory_to_a_millionth_against_apost():
    follicle = Oscillation(angles=(0.35, 0.1, 0.2), shift=(5e-4, 0, 0))
    times = np.arange(1.0, 101.0) * 1e-3
    smooth = replace(C2, friction=0.0)
    trace = _run(Job(smooth, follicle, (post(0.010, 0.002),), times), record_shape=True)[0]
    assert trace.contact.any()
    assert trace.link_positions is not None
    # The recorded shape uses the prescribed base; the engine's own base is checked through its state.
    from brainbench.stimuli.engines.mujoco import model as _mujoco_model

    job = Job(C2, follicle, (post(0.010, 0.002),), times)
    steps = np.arange(0.0, 1002.0) * 1e-4
    chain = build_chain(C2, 8)
    reach = reachable(C2, follicle.pose(steps)[0], job.obstacles, steps)
    built = _mujoco_model.build_model(job, chain, reach, 1e-4, steps)
    followed = _follow(built, len(steps) - 1)
    wanted = built.drives[-1].position
    assert np.ptp(wanted, axis=0).min() > 0.1
    assert np.abs(followed - wanted).max() < 1e-6 * np.ptp(wanted, axis=0).max()
