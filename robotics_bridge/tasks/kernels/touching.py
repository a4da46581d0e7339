"""Objects that the finger tips touch. Letters: B environment, C contact, G geometry, K object."""

import warp as wp


@wp.kernel(module="unique")
def find_touched(
    count: wp.array(dtype=wp.int32),  # [1] contacts in use
    geoms: wp.array(dtype=wp.vec2i),  # [C]
    env: wp.array(dtype=wp.int32),  # [C]
    distance: wp.array(dtype=wp.float32),  # [C] (m)
    role: wp.array(dtype=wp.int32),  # [G] 1: finger tip, 2 + k: object k, 0: neither
    touched: wp.array2d(dtype=wp.int32),  # [B, K] set to 1
):
    # A thread is a contact.
    c = wp.tid()
    if c >= count[0] or distance[c] > 0.0:
        return
    pair = geoms[c]
    if pair[0] < 0 or pair[1] < 0:
        return
    a = role[pair[0]]
    b = role[pair[1]]
    # Many threads may write the same 1, so no atomic operation is needed.
    if a == 1 and b >= 2:
        touched[env[c], b - 2] = 1
    if b == 1 and a >= 2:
        touched[env[c], a - 2] = 1
