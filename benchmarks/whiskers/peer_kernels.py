"""Kernels that move the pegs of :mod:`benchmarks.whiskers.peers` within a recorded graph."""

import warp as wp


@wp.kernel
def move_pegs(
    places: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
    step: wp.array(dtype=int),  # type: ignore[valid-type]
    bodies: wp.array(dtype=int),  # type: ignore[valid-type]
    apart: float,
    poses: wp.array(dtype=wp.transform),  # type: ignore[valid-type]
) -> None:
    row = wp.tid()
    place = places[wp.min(step[0], places.shape[0] - 1)]
    poses[bodies[row]] = wp.transform(place + wp.vec3(0.0, apart * float(row), 0.0), wp.quat_identity())  # type: ignore[arg-type]


@wp.kernel
def advance(step: wp.array(dtype=int)) -> None:  # type: ignore[valid-type]
    step[0] = step[0] + 1
