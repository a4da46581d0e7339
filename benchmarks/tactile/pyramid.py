"""The published throughput scene: a pyramid of ten boxes on a plane (thesis figure 4.3)."""

from __future__ import annotations

from typing import Any

import numpy as np

from brainbench.core.devices import mujoco_module

mujoco = mujoco_module()

EDGE = 0.25
"""Edge of a box (m)."""
SPACING = 0.999
"""Distance of neighbouring boxes in edges."""
ROWS = 4
"""Boxes in the lowest row."""


def pyramid() -> Any:
    """Return the ``mujoco.MjModel`` of the pyramid: links ``box0`` … ``box9``, time step 0.01 s.

    Numbers run up each leaning column, so that ``box1`` rests on ``box0`` (and on its neighbour), as published.
    The boxes start one thousandth of an edge into one another, so that the published warm-up settles them.
    """
    half, pitch = EDGE / 2, EDGE * SPACING
    boxes = []
    for column in range(ROWS):
        for level in range(ROWS - column):
            x, z = (column + level / 2) * pitch, half + level * pitch
            boxes.append(
                f'<body name="box{len(boxes)}" pos="{x} 0 {z}"><freejoint/>'
                f'<geom name="box{len(boxes)}" type="box" size="{half} {half} {half}" density="1000"/></body>'
            )
    return mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.01" tolerance="1e-5"/><worldbody>'
        f'<geom name="floor" type="plane" size="0 0 1"/>{"".join(boxes)}</worldbody></mujoco>'
    )


def initial_velocities(num_envs: int, dofs: int, seed: int = 0) -> np.ndarray:
    """Return the published random start velocities [B, nv]: 0.04 times uniform numbers in [0, 1)."""
    return 0.04 * np.random.default_rng(seed).random((num_envs, dofs))
