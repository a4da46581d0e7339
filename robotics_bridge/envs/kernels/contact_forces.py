"""Net normal contact forces on rows of links. Letters: B environment, C contact, G geometry, R row."""

import warp as wp


@wp.kernel(module="unique")
def add_contact_forces(
    count: wp.array(dtype=wp.int32),  # [1] contacts in use
    geoms: wp.array(dtype=wp.vec2i),  # [C]
    env: wp.array(dtype=wp.int32),  # [C]
    normal: wp.array(dtype=wp.vec3f),  # [C] from the first geometry to the second
    force: wp.array(dtype=wp.float32),  # [C] (N)
    row: wp.array(dtype=wp.int32),  # [G] row of each geometry; -1 for none
    total: wp.array2d(dtype=wp.vec3f),  # [B, R] (N), added to
):
    # A thread is a contact: its force acts on the second geometry, the opposite one on the first.
    c = wp.tid()
    if c >= count[0]:
        return
    pair = geoms[c]
    f = force[c]
    if not wp.isfinite(f):
        return
    # Newton's third law with the normal from the first geometry to the second; friction is left out, as in the
    # published senses. A flex (−1) has no row, and what it presses does.
    push = f * normal[c]
    for side in range(2):
        geometry = pair[side]
        if geometry >= 0:
            if row[geometry] >= 0:
                wp.atomic_add(total, env[c], row[geometry], wp.where(side == 1, push, -push))
